"""The tutorials' pictures: `python notebooks/gallery.py` runs every notebook and saves what it names `gallery`.

Arguments choose notebooks by their numbers: `python notebooks/gallery.py 02 04`.
"""

import json
import sys
from pathlib import Path

import jax
import matplotlib

HERE = Path(__file__).parent
FOLDER = HERE.parent / "docs" / "gallery"
WIDTH = 480  # pixels
LARGEST = 140_000  # bytes; beyond that a palette, which makes small files of few colours


def main(numbers: list[str]) -> None:
    """Save the pictures of the notebooks whose names start with one of the numbers, or of all."""
    from matplotlib import pyplot as plt
    from PIL import Image

    matplotlib.use("Agg")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for path in sorted(HERE.glob("*.ipynb")):
        if numbers and not path.name.startswith(tuple(numbers)):
            continue
        jax.config.update("jax_enable_x64", False)  # some notebooks turn it on
        names: dict = {"__name__": "__main__"}
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), path.name, "exec"), names)
        plt.close("all")
        if "gallery" not in names:
            print(f"{path.name} has no figure named `gallery`")
            continue
        picture = FOLDER / f"{path.name[:2]}.png"
        names["gallery"].savefig(picture, dpi=150, facecolor="white")
        image = Image.open(picture).convert("RGB")
        image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)
        image.save(picture, optimize=True)
        if picture.stat().st_size > LARGEST:
            image.quantize(256).save(picture, optimize=True)
        kilobytes = picture.stat().st_size / 1000
        print(f"{picture.relative_to(HERE.parent)}: {image.width} x {image.height}, {kilobytes:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
