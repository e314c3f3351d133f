"""The names of the room, each with its home."""

from .contact_gains import ContactGains as ContactGains
from .report import Analysis as Analysis
