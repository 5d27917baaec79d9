"""Pages from notebooks and from the root, formulas, and a check of the reference, for mkdocs."""

import ast
import json
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
_OWN_PLACE = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
_FORMULA = re.compile(r"`[^`]*`|\$\$(?P<block>.+?)\$\$|(?<!\\)\$(?P<inline>[^$\n]+?)\$", re.DOTALL)


def on_pre_build(config):
    """Every public name stands in the reference.

    Raises:
        PluginError: some do not; the text names them.
    """
    for package in ("jaxsubdiv", "fitting"):
        tree = ast.parse((ROOT / package / "__init__.py").read_text(encoding="utf-8"))
        imports = [name for node in tree.body if isinstance(node, ast.ImportFrom) for name in node.names]
        public = {each.asname for each in imports if each.asname and not each.asname.startswith("_")}
        page = (ROOT / "docs" / "reference" / f"{package}.md").read_text(encoding="utf-8")
        shown = {path.rsplit(".", 1)[-1] for path in re.findall(r"^::: (\S+)$", page, re.MULTILINE)}
        if public - shown:
            raise PluginError(f"docs/reference/{package}.md lacks {', '.join(sorted(public - shown))}")


def on_files(files, config):
    """Adds the pages whose text is kept elsewhere."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"tutorials/{path.stem}.md", content=_page_of(path)))
    for page, name in _OWN_PLACE.items():
        text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    return files


def _page_of(path: Path) -> str:
    """A notebook as Markdown, not run: its picture, its words and its code."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else _with_formulas(text))
    title, _, rest = parts[0].partition("\n")
    picture = f"![What this notebook draws](../gallery/{path.stem[:2]}.png)"
    origin = f"*This page is `notebooks/{path.name}` without its outputs. Run the notebook to see all pictures.*"
    return "\n\n".join([title, origin, picture, rest, *parts[1:]])


def _with_formulas(text: str) -> str:
    """LaTeX as MathML, which browsers draw without a script."""

    def replaced(found: re.Match) -> str:
        if found["block"]:
            return convert(found["block"].strip(), display="block")
        return convert(found["inline"]) if found["inline"] else found[0]

    return _FORMULA.sub(replaced, text)
