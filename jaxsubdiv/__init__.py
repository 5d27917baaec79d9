"""Differentiable subdivision surfaces of triangles and quads, in JAX."""

from importlib.metadata import version as _version

from ._admissible import admissible_margin as admissible_margin
from ._control import Control as Control
from ._control import strong_float as strong_float
from ._control_faces import child_edge_faces as child_edge_faces
from ._control_faces import control_edges as control_edges
from ._control_faces import control_faces_of as control_faces_of
from ._control_faces import splits_in_four as splits_in_four
from ._creases import Creases as Creases
from ._curvature import Curvatures as Curvatures
from ._curvature import curvatures as curvatures
from ._draw import draw_surface as draw_surface
from ._draw import view_of as view_of
from ._edge_length import edge_length as edge_length
from ._evaluate import SurfaceJet as SurfaceJet
from ._evaluate import evaluate_control as evaluate_control
from ._io import PointCloud as PointCloud
from ._io import read_frame as read_frame
from ._io import read_labelled_points as read_labelled_points
from ._io import read_mesh as read_mesh
from ._io import read_points as read_points
from ._io import write_mesh as write_mesh
from ._memory import keep_freed_memory as keep_freed_memory
from ._mesh import ControlMesh as ControlMesh
from ._mesh import vector_areas as vector_areas
from ._normals import estimate_normals as estimate_normals
from ._refine import refine as refine
from ._saved_topology import load_topology as load_topology
from ._saved_topology import save_topology as save_topology
from ._scheme import SCHEMES as SCHEMES
from ._scheme import AbstractScheme as AbstractScheme
from ._scheme import BezierTriangle as BezierTriangle
from ._scheme import CatmullClark as CatmullClark
from ._scheme import CirclePreserving as CirclePreserving
from ._scheme import DooSabin as DooSabin
from ._scheme import Interpolating as Interpolating
from ._scheme import Kobbelt as Kobbelt
from ._scheme import Loop as Loop
from ._scheme import ModifiedButterfly as ModifiedButterfly
from ._seams import SplitMesh as SplitMesh
from ._seams import split_normals as split_normals
from ._stencils import interpolating_control as interpolating_control
from ._stencils import stencils as stencils
from ._surface import PointsAndNormals as PointsAndNormals
from ._surface import RefinedSurface as RefinedSurface
from ._surface import SurfacePoint as SurfacePoint
from ._surface import corner_weights as corner_weights
from ._surface import evaluate as evaluate
from ._surface import sample as sample
from ._surface import sum_corners as sum_corners
from ._topology import Topology as Topology
from ._topology import build_topology as build_topology
from .errors import MeshError as MeshError

__version__ = _version("jaxsubdiv")
