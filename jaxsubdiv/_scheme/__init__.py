"""The register of schemes: commands, recipes, comparisons and tests read it."""

from .base import AbstractScheme
from .bezier_triangle import BezierTriangle
from .butterfly import ModifiedButterfly
from .catmull_clark import CatmullClark
from .circle_preserving import CirclePreserving
from .doo_sabin import DooSabin
from .interpolating import Interpolating
from .kobbelt import Kobbelt
from .loop import Loop

SCHEMES: dict[str, type[AbstractScheme]] = {
    "interpolating": Interpolating,
    "circle": CirclePreserving,
    "bezier-triangle": BezierTriangle,
    "butterfly": ModifiedButterfly,
    "kobbelt": Kobbelt,
    "catmull-clark": CatmullClark,
    "loop": Loop,
    "doo-sabin": DooSabin,
}
"""Every scheme by its name on the command line; a new one is one line here."""
