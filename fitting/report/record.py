"""All that a fit found and was made from: data alone, which reports, posteriors and saved fits read."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js

from ..finding import Origin
from ..model.pairing import Look, Scene
from ..model.recipe import Settings
from ..model.residual import Held, Model
from ..model.unknowns import Variables
from ..scan.regions import RegionMatch
from ..scan.scan import Scan
from ..solve.collision_free import make_guard
from ..solve.sparse_normal import SparseEquations
from ..solve.strengths import Strengths
from ..solve.structure import Structure, find_structure
from ..solve.sweeps import HOLD, active_unknowns, hold_priors, hold_sweep, loose_damping, measure_look


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fit where it ended.

    Attributes:
        model: what was fitted.
        y: the variables found.
        scene: the scan, as the fit looked at it.
        look: what it saw from the surface found.
        strengths: of the priors.
        hold: what damped the unknowns in the last sweep, `[n]`.
        shifting: whether slices were free to be shifted.
        scan: as it was given.
        start: the control where the fit started, with the normals that it took.
        inputs: what belongs to the scan alone, by name; see `Start.inputs`.
        settings: what the fit was told.
        rms, robust_rms: of the distances in mm, at the start and after every sweep.
        result: why it ended.
        origin: how it came to its start.
        structure: what the analysis found, where the fit was solved on the host; a saved fit is analysed again.
    """

    model: Model
    y: Variables
    scene: Scene
    look: Look
    strengths: Strengths
    hold: Float[np.ndarray, "n"]
    shifting: bool
    scan: Scan
    start: js.Control
    inputs: dict[str, Any]
    settings: Settings
    rms: Float[np.ndarray, "sweeps"]
    robust_rms: Float[np.ndarray, "sweeps"]
    result: optx.RESULTS
    origin: Origin = dataclasses.field(default_factory=Origin)
    structure: Structure | None = None

    @property
    def topology(self) -> js.Topology:
        """Tables of the control mesh."""
        return self.model.topology

    @property
    def active(self) -> Bool[np.ndarray, "k"]:
        """Which shared unknowns took part."""
        return active_unknowns(self.model, np.asarray(self.shifting))

    @property
    def loose(self) -> Float[np.ndarray, "n"]:
        """The damping of unknowns that go on."""
        return loose_damping(self.model)

    @property
    def last_hold(self) -> Float[np.ndarray, "n"]:
        """What damped the unknowns in the last sweep, but no faster than by one turn back."""
        return np.minimum(self.hold, HOLD * self.loose)

    @property
    def inliers(self) -> Bool[np.ndarray, "p"]:
        """Points within three times the noise."""
        return np.abs(np.asarray(self.look.distances, np.float64)) <= 3 * float(self.look.noise)

    @property
    def likeness(self) -> float:
        """The likeness, as a mean over all bends: those of a mesh that was split are mostly not expected."""
        bend: Any = self.model.prior("bend")
        return float(self.strengths.values["likeness"]) * float(np.mean(np.asarray(bend.template) != 0))

    @property
    def shifts(self) -> Float[np.ndarray, "s 3"]:
        """How far each slice was shifted in mm; no row where none was free."""
        if not self.shifting or "shifts" not in self.y.shared:
            return np.zeros((0, 3))
        prior: Any = self.model.prior("shift")
        return np.einsum("sj,sjx->sx", np.asarray(self.y.shared["shifts"], np.float64), np.asarray(prior.planes))

    @property
    def regions(self) -> RegionMatch | None:
        """Of the control faces, and of labels; None where there are none."""
        return self.inputs.get("regions")

    @property
    def slices(self) -> Int[np.ndarray, "s"]:
        """Their numbers."""
        prior: Any = self.model.prior("shift")
        return np.asarray(prior.numbers)[: len(self.shifts)] if prior is not None else np.zeros(0, int)

    def surface(self) -> js.RefinedSurface:
        """The surface found."""
        return self.model.refine(self.y)

    def gather_held(self) -> Held:
        """What the sweep after the last would hold fixed: the `args` of its residual."""
        surface = self.surface()
        held, _ = hold_priors(self.model, self.y, surface, self.strengths.values, self.scene)
        guard = make_guard(self.model, self.y)
        if guard is not None:
            held |= {"contact": guard.find_contacts(surface, self.look, guard.crossing_faces(surface))}
        return hold_sweep(self.model, self.y, self.scene, self.look, self.look.at, self.strengths, held)

    def equations(self) -> SparseEquations:
        """The normal equations about the surface found."""
        held = self.gather_held()
        structure = self.structure or find_structure(self.model, self.y, held.priors)
        return SparseEquations(structure, self.model, self.y, held)


def choose_faces(regions: RegionMatch | None, model: Model, y: Variables, scan: Scan) -> js.FaceChoice | None:
    """The faces of the surface that each point of a scan may be paired with; None where all may be with any."""
    if regions is None or not regions.groups:
        return None
    owner = js.control_faces_of(model.scheme, model.topology, model.refine(y), y.control)
    return regions.choice(scan, owner)


def look_at(model: Model, y: Variables, scene: Scene, loss: Any) -> Look:
    """The scan as seen from a surface, the loss at the scale of the noise."""
    strengths = {"likeness": jnp.zeros(())} | {
        one.name: one.first_strengths() for one in model.priors if one.n_strengths
    }
    return measure_look(model, y, model.refine(y), scene, loss, strengths)
