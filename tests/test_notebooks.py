"""Every notebook runs from top to bottom as plain Python, and is kept without outputs; and so do the pages."""

import json
import re
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
# What a notebook needs of the extra `test`, and sizes at which it is run here: those of the notebook take minutes.
NEEDS = {"08_train_a_layer": ("optax",), "09_to_simulation": ("skfem", "pytetwild")}
MIXES_TYPES = ("08_train_a_layer",)  # optimisers multiply floating numbers by whole ones
SMALLER = {
    "09_to_simulation": ("edge, depth = 7.0, 2.0", "edge, depth = 12.0, 2.0"),
    "08_train_a_layer": (
        "n_steps, batch, n_target, n_held_out, levels = 400, 8, 800, 8, 2",
        "n_steps, batch, n_target, n_held_out, levels = 3, 2, 40, 1, 1",
    ),
}


def _code_cells(path: Path) -> list[dict]:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs_from_top_to_bottom(path, monkeypatch, tmp_path):
    for module in NEEDS.get(path.stem, ()):
        pytest.importorskip(module)
    with jax.numpy_dtype_promotion("standard" if path.stem in MIXES_TYPES else "strict"):
        _run(path, monkeypatch, tmp_path)


def _run(path, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("Agg")
    names: dict = {"__name__": "__main__"}
    full, smaller = SMALLER.get(path.stem, ("", ""))
    sources = ["".join(cell["source"]) for cell in _code_cells(path)]
    assert any(full in source for source in sources)
    for number, source in enumerate(sources, start=1):
        exec(compile(source.replace(full, smaller) if full else source, f"{path.name}, cell {number}", "exec"), names)
        plt.close("all")  # as a notebook does after every cell


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_is_kept_without_outputs(path):
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in _code_cells(path))


def test_examples_of_how_a_fit_works_run():
    text = (Path(__file__).parents[1] / "docs" / "how_a_fit_works.md").read_text(encoding="utf-8")
    names: dict = {"__name__": "page"}
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", text, re.DOTALL), start=1):
        exec(compile(block, f"how_a_fit_works.md, example {number}", "exec"), names)
    assert names["control"].vertices.shape == names["template"].vertices.shape
