"""Pages of the documentation site that are made from elsewhere: start, recipes, contributing, the API."""

import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import mkdocs_gen_files

from nvsf_core.recipe.presets import preset, preset_names

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("nvsf_core", "assets", "pipelines")


def _page(name: str, text: str) -> None:
    with mkdocs_gen_files.open(name, "w") as page:
        page.write(text)


def _from_root(text: str) -> str:
    """Links of a page at the root of the checkout, as they are from the site's own root."""
    text = re.sub(r"\]\(docs/", "](", text)
    text = text.replace("](CONTRIBUTING.md)", "](contributing.md)").replace(
        "](decisions)", "](decisions/index.md)"
    )
    # Other files of the checkout are not part of the site; pictures of the pages are.
    return re.sub(r"(?<!!)\[([^\]]*)\]\((?!https?:|[a-z_/]+\.md|#)[^)]*\)", r"\1", text)


def _api() -> list[str]:
    """One page a folder, its modules one below the other; lines of the navigation."""
    lines = []
    for top in FOLDERS:
        folders = sorted({path.parent for path in (ROOT / top).rglob("*.py")})
        for folder in folders:
            name = folder.relative_to(ROOT).as_posix()
            modules = sorted(
                path.stem for path in folder.glob("*.py") if path.stem not in ("__init__", "__main__")
            )
            if not modules:
                continue
            dotted = name.replace("/", ".")
            blocks = "\n\n".join(f"::: {dotted}.{module}" for module in modules)
            _page(f"api/{dotted}.md", f"# {dotted}\n\n{blocks}\n")
            lines.append(f"* [{dotted}]({dotted}.md)\n")
    return lines


def _recipes() -> str:
    """What the README says of recipes, and how each differs from the default values of its family."""
    said = (ROOT / "README.md").read_text().partition("## Recipes")[2].partition("\n## ")[0]
    rows = ["| recipe | family | what differs from the family's defaults |", "| --- | --- | --- |"]
    for recipe in map(preset, preset_names()):
        others = ", ".join(_differences(recipe, type(recipe)(name=recipe.name)))
        rows.append(f"| `{recipe.name}` | {recipe.family} | {others or 'nothing'} |")
    table = "\n".join(rows)
    specs = "\n\n".join(f"::: nvsf_core.recipe.{name}" for name in ("residual", "paper", "bounds"))
    return f"# Recipes\n{_from_root(said)}\n## All presets\n\n{table}\n\n## Every value\n\n{specs}\n"


def _differences(recipe: Any, plain: Any, prefix: str = "") -> list[str]:
    """Values of a recipe, or of a part of one, that are not those of `plain`."""
    found = []
    for one in fields(recipe):
        value, default = getattr(recipe, one.name), getattr(plain, one.name)
        if value == default or one.name == "name":
            continue
        if is_dataclass(value) and type(value) is type(default):
            found += _differences(value, default, f"{prefix}{one.name}.")
        else:
            found.append(f"`{prefix}{one.name}` {'is added' if is_dataclass(value) else value}")
    return found


_page("recipes.md", _recipes())
_page("index.md", _from_root((ROOT / "README.md").read_text()))
_page("contributing.md", _from_root((ROOT / "CONTRIBUTING.md").read_text()))
decisions = sorted((ROOT / "docs/decisions").glob("*.md"))
titles = [f"* [{path.read_text().splitlines()[0].lstrip('# ')}]({path.name})\n" for path in decisions]
_page("decisions/index.md", "# Decisions\n\n" + "".join(titles))
_page("decisions/SUMMARY.md", "* [All](index.md)\n" + "".join(titles))
_page("api/SUMMARY.md", "".join(_api()))
