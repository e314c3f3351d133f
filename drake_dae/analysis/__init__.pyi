"""The names of the room, each with its home."""

from .examination import along as along
from .examination import analyze as analyze
from .examination import examine as examine
from .limits import Excess as Excess
from .limits import LimitKind as LimitKind
from .limits import LimitsAlong as LimitsAlong
from .limits import SignalLimits as SignalLimits
from .limits import SignalRange as SignalRange
from .limits import limits_along as limits_along
from .limits import robot_limits as robot_limits
from .report import Analysis as Analysis
from .report import Assumption as Assumption
from .report import Finding as Finding
from .tables import Part as Part
from .tables import Table as Table
from .tables import count_of as count_of
from .tables import digits as digits
from .tables import to_text as to_text
