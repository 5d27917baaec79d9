"""`jaxsubdiv.fitting`, for those who have another distribution of the name `fitting`."""

import os
import subprocess
import sys

import fitting
import jaxsubdiv.fitting as alias


def test_alias_is_the_package_where_nothing_hides_it():
    assert alias is fitting


def test_alias_finds_the_package_that_another_one_hides(tmp_path):
    (tmp_path / "fitting.py").write_text("stranger = True\n")
    code = (
        "import fitting, jaxsubdiv.fitting as ours; from jaxsubdiv.fitting import Scan; assert fitting.stranger\n"
        "scan, mesh = ours.example('femur_distal'); print(isinstance(scan, Scan), scan.n_points, ours.Free().h)"
    )
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    environment = os.environ | {"PYTHONPATH": path}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.stdout.split() == ["True", str(fitting.example("femur_distal")[0].n_points), "True"], done.stderr
