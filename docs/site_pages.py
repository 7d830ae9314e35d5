"""Pages of the documentation site that are made from elsewhere: start, contributing, the API."""

import re
from pathlib import Path

import mkdocs_gen_files

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
    # Other files of the checkout are not part of the site.
    return re.sub(r"\[([^\]]*)\]\((?!https?:|[a-z_/]+\.md|#)[^)]*\)", r"\1", text)


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


_page("index.md", _from_root((ROOT / "README.md").read_text()))
_page("contributing.md", _from_root((ROOT / "CONTRIBUTING.md").read_text()))
decisions = sorted((ROOT / "docs/decisions").glob("*.md"))
titles = [f"* [{path.read_text().splitlines()[0].lstrip('# ')}]({path.name})\n" for path in decisions]
_page("decisions/index.md", "# Decisions\n\n" + "".join(titles))
_page("decisions/SUMMARY.md", "* [All](index.md)\n" + "".join(titles))
_page("api/SUMMARY.md", "".join(_api()))
