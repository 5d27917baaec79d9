"""Cohorts on many devices and in several processes: the same fits as on one device."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

# In processes of their own: the number of devices is chosen when JAX starts.
_ONE_OF_TWO = """
import sys
import jax, numpy as np
import fitting, jaxsubdiv as js
from jax.sharding import Mesh
folder, address, number = sys.argv[1], sys.argv[2], int(sys.argv[3])
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(address, 2, number)
assert len(jax.devices()) == 8 and len(jax.local_devices()) == 4

corners = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
sides = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (1, 0, 5), (2, 1, 5), (3, 2, 5), (0, 3, 5)]
mesh, scheme, rng = js.ControlMesh(10 * np.array(corners), sides), js.Interpolating(), np.random.default_rng(0)
topology = js.build_topology(mesh, scheme, 1)
ball = np.asarray(js.refine(scheme, topology, mesh.control()).vertices)
points = ball[rng.integers(len(ball), size=(16, 40))] * rng.uniform(0.8, 1.2, (16, 1, 3))
points += rng.normal(scale=0.1, size=points.shape)
scans = [fitting.Scan(rows[: 40 - i]) for i, rows in enumerate(points)]
free, priors = fitting.Free(normals=False, h=False), fitting.Priors(bend=0.5, likeness=0.0)

def fit_all(name, devices):
    over = None if devices is None else Mesh(np.array(devices).reshape(2, -1), ("a", "b"))
    found = fitting.fit_cohort(
        scheme, topology, mesh.control(), scans, free=free, priors=priors, max_sweeps=4, mesh=over, checkpoint=name
    )
    last = found.result(15)
    np.savez(f"{folder}/{name}.npz", found.control.vertices, found.weights, found.sweeps, last.distances)

fit_all(f"eight_{number}", jax.devices())
fit_all("one", None) if number == 0 else fit_all("four", jax.local_devices())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="processes talk by gloo, which jaxlib has on Linux and macOS")
def test_subjects_are_divided_between_devices_and_processes(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    environment = os.environ | {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=4 --xla_cpu_use_fusion_emitters=false",
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",  # half of the time is that of compiling
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    command = [sys.executable, "-W", "ignore", "-c", _ONE_OF_TWO, str(tmp_path), address]
    how = {"env": environment, "cwd": tmp_path, "stderr": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([*command, str(k)], **how) for k in range(2)]
    try:
        errors = [process.communicate(timeout=600)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()  # one that has ended hears nothing
    assert all(process.returncode == 0 for process in processes), errors
    found = {name: np.load(tmp_path / f"{name}.npz") for name in ("one", "four", "eight_0", "eight_1")}
    for name in ("four", "eight_0", "eight_1"):
        for key, values in found["one"].items():
            np.testing.assert_allclose(found[name][key], values, atol=1e-5)
    for folder, n in (("one", 16), ("four", 4), ("eight_0", 2)):  # the first process keeps what both have finished
        assert len(list((tmp_path / folder).iterdir())) == n
    assert not (tmp_path / "eight_1").exists()
