"""All mechanisms of the referee, by name."""

from referee.planar import PLANAR_MECHANISMS
from referee.spatial import SPATIAL_MECHANISMS

MECHANISMS = {mechanism.name: mechanism for mechanism in PLANAR_MECHANISMS + SPATIAL_MECHANISMS}
