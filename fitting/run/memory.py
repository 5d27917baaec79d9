"""How much memory a fit takes, told before it starts."""

import jaxsubdiv as js

# Bytes, as `tests/bench/fit_memory.py` measures them: of Python with JAX and what it compiles; of a control vertex,
# most of it the factors of the normal equations; of a face of the surface; and of a point, as many as are worked on at
# once, and the others.
_PROGRAMS, _VERTEX, _FACE = 850e6, 300e3, 3e3
_POINT, _AT_ONCE, _OTHER_POINT = 1.7e3, 200_000, 250.0


def memory_of_fit(topology: js.Topology, n_points: int) -> float:
    """About how many bytes a process has to have for a fit in float32 and its uncertainty, within a third."""
    n_vertices, n_faces = topology.n_control_vertices, sum(len(faces) for faces in topology.faces.values())
    points = _POINT * min(n_points, _AT_ONCE) + _OTHER_POINT * n_points
    return _PROGRAMS + _VERTEX * n_vertices + _FACE * n_faces + points
