"""What is known of a surface before it is measured: the settings, and the register of priors."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxsubdiv import strong_float

from ..limits import check_numbers
from .base import AbstractFacePrior, AbstractPrior, AbstractSurfacePrior, AbstractVertexPrior, Place, Start
from .bend import Bend
from .boundary import BoundaryPrior
from .contact import ContactPrior
from .height import Height
from .landmarks import LandmarkPrior
from .margin import Margin
from .series import SeriesPrior
from .shape_modes import ShapeModes, ShapePrior
from .shifts import ShiftPrior
from .stretch import Stretch
from .symmetry import SymmetryPrior
from .tangent_length import TangentLength
from .thickness import ThicknessPrior
from .valves import ValvePrior

REGISTER: tuple[type[AbstractPrior], ...] = (
    Bend,
    Height,
    Stretch,
    Margin,
    LandmarkPrior,
    BoundaryPrior,
    ValvePrior,
    TangentLength,
    ShiftPrior,
    SymmetryPrior,
    ShapePrior,
    SeriesPrior,
    ThicknessPrior,
    ContactPrior,
)
"""Every prior, in the order of its rows; a new one is one line here, and a field of `Priors` for its settings."""

__all__ = [
    "REGISTER",
    "AbstractFacePrior",
    "AbstractPrior",
    "AbstractSurfacePrior",
    "AbstractVertexPrior",
    "Place",
    "Priors",
    "Start",
]


def _if_given(value: object) -> Float[Array, ""] | None:
    return None if value is None else strong_float(value)


class Priors(eqx.Module):
    """What is known of a surface before it is measured, each as the standard deviation that is expected.

    A prior of the standard deviation `jnp.inf` is left out.

    Attributes:
        bend: of the bend asymmetry of an edge in mm (see `bend_asymmetry`): small is smooth. None, the default: found
            from the scan, place by place, as that which makes the scan most probable (see `_evidence`).
        stretch: of the change of a control edge along the surface, against the control mesh where the fit starts, as a
            part of the edge's length. It keeps the control vertices in their places where the scan does not.
        h: of the tangent length coefficient about 1.
        symmetry: of the departure of a control vertex from the mirror image of its partner in mm, in each coordinate;
            of control normals, by as much as they move the surface. Default: left out. The mirror plane moves along
            with the mesh; `fit` finds the partners, or is given them (see `find_symmetry`).
        likeness: how much of the control mesh's own bend asymmetry, where the fit starts, is expected of the surface,
            from 0 to 1; `bend` is then of the departure from that. No standard deviation, unlike the others. Unless it
            is 0, the control mesh's curvature is expected too (see `bend_height`), as closely as the scan shows place
            by place: holes of the scan are filled as the control mesh is shaped. None, the default: the likeness that
            makes the scan most probable, about 0.9 where the control mesh is the same anatomy of another person and
            about 0 where its details say nothing of the scan's; and 0 where `bend` is given. Give 0 where the control
            mesh was made from this very scan or fitted to it before, for its noise would be expected again. With `bend`
            given, nothing is expected of curvature.
        shape: the family that the control mesh is one of: a `Cohort` whose control meshes correspond to this one, their
            `Modes` as `shape_modes` finds them, or a `ShapeModes`. Where the scan lacks something, it is filled by
            scores along the modes that the rest of the scan shows. Default: left out.
        shift: of how far breathing displaced a slice of the scan, in mm, along each of two axes of the slice's plane.
        frame_change: of how far a control vertex moves from one frame of a series to the next, in mm, in each
            coordinate; see `fit_series`. None, the default: found from the scans.
        thickness: of how much thicker what lies between two layers is at a control vertex than at the next, in mm; see
            `fit_layers`. None, the default: found from the scan, place by place.
        contact: how near places of the refined surface come before they repel, as a part of the heights of its
            triangles there, 0.25 say; nearer where the scan itself has layers that are. No standard deviation. Where it
            is not 0, `fit` also shortens every step until the surface does not pass through itself where it did not
            before. That takes the extra `contact` and the sparse solver; cohorts and series refuse it. 0, the default:
            the surface may cross itself, and the report says where.

    Raises:
        ValueError: a standard deviation is not positive, the likeness not from 0 to 1, or `contact` not from 0 to 0.5.
    """

    bend: Float[Array, ""] | None = eqx.field(converter=_if_given, default=None)
    stretch: Float[Array, ""] = eqx.field(converter=strong_float, default=0.2)
    h: Float[Array, ""] = eqx.field(converter=strong_float, default=0.05)
    symmetry: Float[Array, ""] = eqx.field(converter=strong_float, default=np.inf)
    shift: Float[Array, ""] = eqx.field(converter=strong_float, default=3.0)
    likeness: Float[Array, ""] | None = eqx.field(converter=_if_given, default=None)
    frame_change: Float[Array, ""] | None = eqx.field(converter=_if_given, default=None)
    shape: ShapeModes | None = eqx.field(converter=ShapeModes.of, default=None)
    thickness: Float[Array, ""] | None = eqx.field(converter=_if_given, default=None)
    contact: Float[Array, ""] = eqx.field(converter=strong_float, default=0.0)

    def __check_init__(self) -> None:
        names = ("bend", "stretch", "symmetry", "shift", "frame_change", "likeness", "thickness")
        check_numbers({name: getattr(self, name) for name in names})
        check_numbers({"h of priors": self.h, "contact": self.contact})
