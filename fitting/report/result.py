"""What a fit returns."""

import dataclasses
import functools
import math
import os
from collections.abc import Mapping, Sequence
from typing import final

import numpy as np
import optimistix as optx
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.notices import warn

from ..finding import Finding
from ..model.pairing import make_scene
from ..model.recipe import Settings
from ..scan.scan import Scan
from .at_level import SurfaceAtLevel
from .coverage import distances_to_scan, weighted_quantile, worst_places
from .evidence import find_own_crossings, gather_evidence
from .findings import find_what_speaks_against
from .fit_measures import (
    CrossSection,
    Measure,
    Numbers,
    measure_cross_section,
    measure_details,
    measure_landmarks,
    measure_surface,
)
from .posterior import Posterior, Uncertainty
from .record import Fit, choose_faces, look_at
from .refit import Refit, make_refit
from .report import RegionDistance, Report, SliceShift, WorstPlace
from .saved import save_fit
from .thickness import Thickness, measure_thickness


@final
class FitResult:
    """A control mesh fitted to a scan, and how well it fits.

    Attributes:
        control: fitted control vertices (mm) and unit normals.
        scheme: the scheme with its fitted h.
        surface: the refined surface of both.
        scan: the scan that was fitted.
        at: the surface point closest to every scan point.
        distances: signed distance of every scan point from the surface in mm, positive outside.
        weights: how much every point counts at the end: its own weight times the robust one.
        inliers: points within three times the noise.
        rms: root mean square distance of the scan points to the surface in mm: at the start, then after every sweep.
        robust_rms: the same with every point by its robust weight, so that outliers do not hide the rest.
        noise: standard deviation in mm of the Gaussian part of the distances: the noise of the scan, and the detail
            that the control mesh is too coarse for.
        result: `optimistix.RESULTS.successful`, or why the fit stopped without having converged.
        likeness: how much of the shape where the fit started was expected of the surface, see `Priors.likeness`; of a
            mesh that was split, as a mean over the surface.
        recipe: the settings that the fit was given, to fit the next scan in the same way.
        start: the control where the fit started, with the normals that it took.
        shifts: how far each slice of the scan was shifted, in mm; no row where none was free to move.
        slices: the number, in `Scan.slices`, of the slice of each row of `shifts`. Slices without a plane have no row.
        points: the scan's points with these shifts put on: where the distances are measured from.
    """

    def __init__(self, fit: Fit, *, recipe: Settings | None = None):
        """
        Args:
            fit: what was found.
            recipe: the settings, where they are not those of the fit.
        """
        self.fit: Fit = fit
        self.control: js.Control = fit.y.control
        self.scheme: js.AbstractScheme = fit.model.scheme_at(fit.y)
        self.surface: js.RefinedSurface = fit.surface()
        self.scan: Scan = fit.scan
        self.start: js.Control = fit.start
        self.at: js.SurfacePoint = fit.look.at
        self.distances: Float[np.ndarray, "p"] = np.asarray(fit.look.distances)
        self.weights: Float[np.ndarray, "p"] = np.asarray(fit.look.weights)
        self.rms: Float[np.ndarray, "sweeps"] = fit.rms
        self.robust_rms: Float[np.ndarray, "sweeps"] = fit.robust_rms
        self.noise: float = float(fit.look.noise)
        self.result: optx.RESULTS = fit.result
        self.recipe: Settings = recipe or fit.settings
        self.likeness: float = fit.likeness
        self.shifts: Float[np.ndarray, "s 3"] = fit.shifts
        self.slices: Int[np.ndarray, "s"] = fit.slices

    @functools.cached_property
    def posterior(self) -> Posterior:
        """The surfaces that scan and priors leave probable; made when it is first asked for."""
        return Posterior(self.fit)

    def uncertainty(self) -> Uncertainty:
        """Standard deviations of the control vertices and of the surface's vertices, across the surface, in mm.

        They say how far the surface may be off the anatomy because of noise, holes and few points, and because the
        control mesh is too coarse for it (see `Uncertainty.misfit`): where points of one control face lie off the
        surface together. Errors that neighbouring points share, as those of one contour, count as such a misfit. Shifts
        of slices count as unknown. Exact for up to 4,000 unknowns, else from random draws.
        """
        return self.posterior.uncertainty()

    def refine_to(self, levels: int | None = None) -> SurfaceAtLevel:
        """The surface at another level of refinement, with the scan's distances and the uncertainty at its vertices.

        Args:
            levels: from 0, the control mesh itself, to 8; default: that of the fit.

        Raises:
            ValueError: there is no such level: the control mesh has creases, or h one value a level.
        """
        own = len(self.fit.topology.levels)
        return SurfaceAtLevel(self.fit, own if levels is None else levels, lambda: self.posterior)

    @functools.cached_property
    def warnings(self) -> list[Finding]:
        """What speaks against the fit, and against where it started; empty where nothing does."""
        areas, to_scan = self._seen_from_the_scan
        return find_what_speaks_against(
            gather_evidence(self.fit, self.surface, areas, ~np.isnan(to_scan), self.crossings, self._faces_of_layers)
        )

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the fit: it converged, and there are no `warnings`."""
        return not self.warnings

    @functools.cached_property
    def _seen_from_the_scan(self) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
        """Of every vertex of the surface its area, and its distance to the scan; see `distances_to_scan`."""
        areas = np.asarray(self.surface.vertex_areas(), np.float64)
        return areas, distances_to_scan(self.surface, self.fit.look, self.inliers)

    @functools.cached_property
    def crossings(self) -> js.Crossings | None:
        """Where the surface goes through itself; None where that is not looked for: without the extra `contact`, and in
        series, whose frames lie in each other. Of layers each is looked at alone: where layers go through each other,
        as they do in turn where they touch, is not counted."""
        if self.fit.inputs.get("frames") is not None:
            return None
        try:
            return find_own_crossings(self.surface, self._faces_of_layers)
        except ImportError:
            return None

    def measures(self, valves: Sequence[str] | None = None, *, details: bool = False) -> tuple[Measure, ...]:
        """Volume, area, and of a wall its cavities, mass and thickness, each with its standard deviation.

        Of layers each has a volume and an area, and between one and the next there are the difference of their volumes
        and the mean thickness.

        Where the control mesh has groups that are valves, the parts between them are measured one by one: the volume of
        each cavity, closed by a flat cap over every opening, and the thickness of the wall around it. The volume of an
        open surface is that under such caps.

        Args:
            valves: the groups that close the openings of cavities; default: those whose names say so.
            details: with the 5th, 50th and 95th percentile of mean and Gaussian curvature over the area, positive on a
                ball; of a closed surface with the centre and the principal moments of inertia of its inside, at 1 g/ml;
                and where the fit has a mirror plane, with the distance of the control vertices from their mirror
                images. Curvatures are differences over the refined surface: those of the interpolating scheme have no
                bound at control vertices, and finer levels show larger ones there.

        Raises:
            ValueError: a group is none of the control mesh.
        """
        found = self._measures if valves is None else measure_surface(self.posterior, self.control_mesh, valves)
        return (*found, *self._details) if details else found

    @functools.cached_property
    def _details(self) -> tuple[Measure, ...]:
        return measure_details(self.posterior)

    def cross_section(self, origin: Numbers, normal: Numbers) -> CrossSection:
        """Area and perimeter of the surface where a plane passes it, with standard deviations, and the contours.

        Args:
            origin: a point of the plane, in mm.
            normal: the direction that the plane is across, of any length.

        Raises:
            ValueError: the plane does not pass the surface.
        """
        return measure_cross_section(self.posterior, origin, normal)

    def measure_landmarks(
        self, landmarks: Mapping[str, Numbers], angles: Sequence[tuple[str, str, str]] = ()
    ) -> tuple[Measure, ...]:
        """Distances between landmarks on the surface, all pairs, and angles, with standard deviations.

        How the surface may slide along itself is in these only as far as the priors and landmarks of the fit say.

        Args:
            landmarks: positions by name, as `carry_landmarks(...).positions`; each moves with the place of the surface
                that is closest to it.
            angles: three names each: that at the second, between the ways to the other two.

        Raises:
            ValueError: fewer than two landmarks, or a name that is none of them.
        """
        return measure_landmarks(self.posterior, landmarks, angles)

    @functools.cached_property
    def _measures(self) -> tuple[Measure, ...]:
        """With the valves that the groups' names say: asked for by every report."""
        return measure_surface(self.posterior, self.control_mesh)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the regions that were fitted as layers, from the inside out; none of other fits."""
        return self.fit.inputs.get("layers") or ()

    @functools.cached_property
    def _faces_of_layers(self) -> tuple[Bool[np.ndarray, "f"], ...]:
        return tuple(self.find_faces(name) for name in self.layers)

    def find_faces(self, region: str) -> Bool[np.ndarray, "f"]:
        """Which faces of the refined surface lie in a region of the control mesh, triangles first.

        Raises:
            ValueError: there is no such region.
        """
        of_control = None if self.fit.regions is None else self.fit.regions.faces
        if of_control is None or region not in of_control.names:
            there = "none" if of_control is None else ", ".join(of_control.names)
            raise ValueError(f"'{region}' is no region of the control mesh; it has {there}.")
        owner = js.control_faces_of(self.scheme, self.fit.topology, self.surface, self.control)
        return of_control.rows[owner] == of_control.names.index(region)

    def thickness(self, region: str, other: str) -> Thickness:
        """How thick what lies between two regions is, at every vertex of one of them, with standard deviations.

        Args:
            region: where it is measured.
            other: the region on the other side, such as the next layer, or the outside of a wall.

        Raises:
            ValueError: there is no such region.
        """
        return measure_thickness(self.posterior, (region, other), self.find_faces(region), self.find_faces(other))

    @functools.cached_property
    def control_mesh(self) -> js.ControlMesh:
        """The fitted control mesh with its normals, for `js.write_mesh`."""
        regions = None if self.fit.regions is None else self.fit.regions.faces
        faces, normals = self.fit.topology.control_faces, self.control.normals
        return js.ControlMesh(self.control.vertices, faces, normals, check=False, regions=regions)

    def refit(self) -> Refit:
        """The fitted control as a differentiable function of scan points and weights; see `Refit`.

        Shifts of slices are held at what the fit found.

        Warns:
            UserWarning: the fit did not converge: the derivative is that of where it stopped.
        """
        if self.result != optx.RESULTS.successful:
            warn(
                "the fit did not converge: what depends on the scan here is the surface where it stopped, not the best "
                "one. Give more `max_sweeps`.",
            )
        return make_refit(self.posterior)

    def compare_with(self, scan: Scan) -> "FitResult":
        """The same surface, measured by another scan: by all points of the one of which a part was fitted, say.

        Correspondences, distances, noise, report and uncertainty are those of its points; the convergence is that of
        the fit. Slices keep the shifts that the fit found for their numbers. The misfit in the uncertainty is somewhat
        too large where the points were not those of the fit.
        """
        fit = self.fit
        planes = None if not fit.shifting or scan.slices is None else fit.inputs.get("slices")
        scene = make_scene(scan, self.surface, planes, choose_faces(fit.regions, fit.model, fit.y, scan))
        look = look_at(fit.model, fit.y, scene, fit.settings.loss)
        rms, robust_rms = (
            np.append(values[:-1], float(new))
            for values, new in ((fit.rms, look.rms), (fit.robust_rms, look.robust_rms))
        )
        again = dataclasses.replace(fit, scene=scene, look=look, scan=scan, rms=rms, robust_rms=robust_rms)
        return FitResult(again, recipe=self.recipe)

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the fit into a folder, made where there is none, for `fitting.load`; and its settings.

        Of the two files `fit.npz` holds everything, control mesh and scan (less its faces) included, and `recipe.json`
        the settings, for `fitting.load_recipe` and for people. Each is complete or not there.

        Raises:
            OSError: the folder cannot be made or written.
            ValueError: the scheme or the loss is of a class of your own, or the control mesh has creases.
        """
        save_fit(folder, self.fit, self.recipe)

    @property
    def points(self) -> Float[np.ndarray, "p 3"]:
        """The scan's points, moved by the shifts of their slices, in mm."""
        return np.asarray(self.fit.look.pairs.points)

    @property
    def inliers(self) -> Bool[np.ndarray, "p"]:
        return self.fit.inliers

    def report(self, *, uncertainty: bool = False, details: bool = False) -> Report:
        """The fit in numbers: `print` it, or take `.as_dict()`.

        Args:
            uncertainty: with that of the surface and with `measures`, which takes a second or more.
            details: with the details of `measures`, too.
        """
        areas, to_scan = self._seen_from_the_scan
        covered = ~np.isnan(to_scan)
        areas_there, away = areas[covered], np.abs(to_scan[covered])
        known, share = bool(areas_there.sum() > 0), areas_there / max(areas_there.sum(), np.finfo(float).tiny)
        spread = self.uncertainty().surface[covered] if uncertainty and known else None
        edge = float(js.edge_length(self.fit.topology, self.control.vertices))
        crossings = self.crossings
        return Report(
            trusted=self.trusted,
            warnings=self.warnings,
            pose=self.fit.origin.pose,
            frame=self.fit.scan.frame,
            converged=bool(self.result == optx.RESULTS.successful),
            reason=_words(self.result),
            sweeps=len(self.rms) - 1,
            rms_start=float(self.rms[0]),
            rms=float(self.rms[-1]),
            mean=float(np.mean(np.abs(self.distances))),
            median=float(np.median(np.abs(self.distances))),
            percentile_95=float(np.percentile(np.abs(self.distances), 95)),
            maximum=float(np.max(np.abs(self.distances))),
            bias=float(np.mean(self.distances)),
            n_points=self.scan.n_points,
            noise=self.noise,
            inlier_share=float(np.mean(self.inliers)),
            rms_inliers=_rms(self.distances[self.inliers]),
            n_control_vertices=self.control.vertices.shape[0],
            n_faces=self.surface.n_faces,
            h=None if self.scheme.h is None else np.asarray(self.scheme.h).tolist(),
            likeness=self.likeness,
            rms_per_sweep=[float(value) for value in self.rms],
            coverage=float(areas_there.sum() / areas.sum()),
            mean_to_scan=float(share @ away) if known else None,
            rms_to_scan=float(np.sqrt(share @ away**2)) if known else None,
            percentile_95_to_scan=weighted_quantile(away, share, 0.95) if known else None,
            maximum_to_scan=float(away.max()) if known else None,
            n_unknowns=_count_unknowns(self.fit),
            determined=float(self.fit.strengths.determined),
            least_margin=float(js.admissible_margin(self.control_mesh).min()) if self.scheme.uses_normals else None,
            crossing_triangles=None if crossings is None else len(crossings.triangles),
            crossings_at=np.median(crossings.places, axis=0).tolist() if crossings and len(crossings.places) else None,
            measures=list(self.measures(details=details)) if uncertainty else [],
            uncertainty_median=None if spread is None else weighted_quantile(spread, share, 0.5),
            uncertainty_95=None if spread is None else weighted_quantile(spread, share, 0.95),
            shifts=[SliceShift(int(i), shift.tolist()) for i, shift in zip(self.slices, self.shifts, strict=True)],
            regions=_distances_of_regions(self.fit),
            worst=[
                WorstPlace(place.position.tolist(), place.distance, place.n_points)
                for place in worst_places(self.surface, self.fit.look, self.distances, edge)
            ],
        )


def _distances_of_regions(fit: Fit) -> list[RegionDistance]:
    """Of the points that were paired within each region, and of those that were with any face."""
    if fit.scene.choice is None or fit.regions is None:
        return []
    distances, of_points = np.asarray(fit.look.distances), np.asarray(fit.scene.choice.of_points)
    weights = np.asarray(fit.scan.relative_weights())
    names = [" + ".join(kind) for kind in fit.regions.kinds] + ["any region"]
    found = []
    for row, name in zip([*range(len(names) - 1), -1], names, strict=True):
        own = (of_points == row) & (weights > 0)
        if own.any():
            rms = float(np.sqrt(np.average(distances[own] ** 2, weights=weights[own])))
            found.append(RegionDistance(name, int(own.sum()), rms, float(np.median(np.abs(distances[own])))))
    return found


def _count_unknowns(fit: Fit) -> int:
    """Numbers that the fit was free to change, and that last."""
    shared = [of for name, of in fit.model.layout.shared if of.lasting and (fit.shifting or name != "shifts")]
    own = np.asarray(fit.model.is_free)[: fit.model.layout.n_own].sum()
    return int(own) + sum(math.prod(of.shape) for of in shared)


def _rms(distances: Float[np.ndarray, "p"]) -> float:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else 0.0


def _words(result: optx.RESULTS) -> str:
    """Why the fit stopped, in words; optimistix's own where they are not about its inner steps."""
    if result == optx.RESULTS.nonlinear_max_steps_reached:
        return "max_sweeps reached before the distances came to rest"
    if result == optx.RESULTS.nonlinear_divergence:
        return "at rest where it started, far from the scan"
    return str(optx.RESULTS[result])
