"""The names of the room, each with its home."""

from .by_name import ReferenceRows as ReferenceRows
from .by_name import references_by_name as references_by_name
from .csv_file import CsvReference as CsvReference
from .formulas import ConstantReference as ConstantReference
from .formulas import ExpressionReference as ExpressionReference
from .formulas import PointToPointReference as PointToPointReference
from .formulas import SinusoidReference as SinusoidReference
from .paths import CircleReference as CircleReference
from .paths import LineReference as LineReference
from .paths import PathLimits as PathLimits
from .reference import Reference as Reference
from .reference import stack_references as stack_references
from .splines import PolylineReference as PolylineReference
from .splines import WaypointsReference as WaypointsReference
