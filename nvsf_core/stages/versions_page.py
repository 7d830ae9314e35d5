"""Collects the versions of all data sets of a home for the page that compares them."""

from collections.abc import Sequence
from pathlib import Path

from nvsf_core.errors import StoreError
from nvsf_core.reporting.versions import VersionFacts, versions_html
from nvsf_core.stages.exports.manifest import MANIFEST_NAME
from nvsf_core.stages.versions import Version, versions_of
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.scene_store import SceneStore

VERSIONS_PAGE = "versions.html"


def write_versions_page(folder: Path, home: Path, scenes: Sequence[str]) -> Path:
    """Write the page into a folder; returns its path.

    Args:
        folder: Where the page is written.
        home: NVSF_HOME.
        scenes: Scenes to show, in this order.
    """
    facts = [_facts(scene, version) for scene in scenes for version in versions_of(SceneStore(home, scene))]
    path = folder / VERSIONS_PAGE
    path.write_text(versions_html(facts), encoding="utf-8", errors="backslashreplace")
    return path


def manifests_of(home: Path, scenes: Sequence[str]) -> list[Path]:
    """The manifests that the page is made from."""
    return [
        version.folder / MANIFEST_NAME
        for scene in scenes
        for version in versions_of(SceneStore(home, scene))
        if (version.folder / MANIFEST_NAME).is_file()
    ]


def _facts(scene: str, version: Version) -> VersionFacts:
    try:
        manifest = dict(read_document(version.folder / MANIFEST_NAME))
    except StoreError:
        manifest = {}
    files = [path for path in version.folder.rglob("*") if path.is_file()]
    return VersionFacts(
        scene=scene, view=version.view, name=version.name, made_s=version.folder.stat().st_mtime,
        megabytes=sum(path.stat().st_size for path in files) / 1e6, manifest=manifest,
    )  # fmt: skip
