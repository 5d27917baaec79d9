"""Topologies written to files, and read again."""

import equinox as eqx
import jax
import numpy as np
import pytest
from schemes import CASES, MIXED, control_mesh

import jaxsubdiv as js


@pytest.mark.parametrize(
    "case", {type(case.scheme).__name__: case for case in CASES}.values(), ids=lambda case: case.name
)
def test_every_scheme_finds_its_tables_again(case, tmp_path):
    mesh, scheme = control_mesh(case.subject.mesh), case.scheme
    topology = js.build_topology(mesh, scheme, 2, limit=scheme.is_linear)
    js.save_topology(tmp_path / "tables.npz", topology)
    again = js.load_topology(tmp_path / "tables.npz")
    assert eqx.tree_equal(again, topology)


def test_seams_creases_and_recomputed_normals_are_kept(tmp_path):
    mesh = control_mesh(MIXED)
    cut, origin = js.split_normals(mesh, angle=30)
    sharp = js.build_topology(cut, js.Interpolating(old_normals="recompute"), 2, seams=origin, mesh_normals=True)
    js.save_topology(tmp_path / "tables", sharp)  # under the name that it was given
    assert eqx.tree_equal(js.load_topology(tmp_path / "tables"), sharp)


def test_what_is_no_saved_topology_is_refused(tmp_path):
    path = tmp_path / "tables.npz"
    with pytest.raises(FileNotFoundError):
        js.load_topology(path)
    np.savez(path, vertices=np.eye(3))
    with pytest.raises(ValueError, match=r"tables\.npz: no saved topology.*about"):
        js.load_topology(path)
    js.save_topology(path, js.build_topology(control_mesh(MIXED), js.Interpolating(), 1))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"tables\.npz: no saved topology, or a damaged one"):
        js.load_topology(path)
    changed = bytearray(whole)
    changed[whole.index(b"table_3.npy") + 400] ^= 1
    path.write_bytes(bytes(changed))
    with pytest.raises(ValueError, match="damaged"):
        js.load_topology(path)


def test_a_later_version_and_levels_of_ones_own_are_refused(tmp_path, monkeypatch):
    path, topology = tmp_path / "tables.npz", js.build_topology(control_mesh(MIXED), js.Interpolating(), 1)
    monkeypatch.setattr("jaxsubdiv._saved_topology._VERSION", 2)
    js.save_topology(path, topology)
    monkeypatch.undo()
    with pytest.raises(ValueError, match="version 2, but this release reads 1"):
        js.load_topology(path)

    class Own(type(topology.levels[0])):
        pass

    own = Own(**vars(jax.tree.map(np.asarray, topology.levels[0])))
    with pytest.raises(ValueError, match="Own has no file format"):
        js.save_topology(path, eqx.tree_at(lambda t: t.levels, topology, (own,)))
