"""The page of versions says what changed and how the metrics moved."""

from typing import Any

from nvsf_core.reporting.versions import VersionFacts, changes, versions_html


def _manifest(**more: Any) -> dict[str, Any]:
    metric = {"protocol": "image", "metric": "image_psnr_db", "region": "all", "split": "test", "value": 20.0}
    return {
        "seed": 0, "draw_seed": 0, "recipe": {"name": "lean", "identity": "a", "camera": {"sources": 4}},
        "view": {"name": "left", "yaw_deg": 0.0}, "source_checksums": {"scan 1": "aa", "scan 2": "bb"},
        "software": {"torch": "2.12"}, "commit": "0123456789abcdef", "scans": [{}], "images": [],
        "rendered_from": {"field": "x"}, "field_metrics": [metric], **more,
    }  # fmt: skip


def test_what_changed_is_said_in_words() -> None:
    now = _manifest(
        seed=1, recipe={"name": "lean", "identity": "b", "camera": {"sources": 6}},
        view={"name": "left", "yaw_deg": 5.0}, source_checksums={"scan 2": "cc", "scan 3": "dd"},
        software={"torch": "2.13"}, commit="fedcba9876543210", rendered_from={"field": "y"},
    )  # fmt: skip
    assert changes(_manifest(), now) == [
        "recipe: camera.sources 4 → 6", "seed 0 → 1", "recorded files: 1 more, 1 fewer, 1 changed",
        "view: yaw_deg 0.0 → 5.0", "commit 01234567 → fedcba98", "torch 2.12 → 2.13", "content of field",
    ]  # fmt: skip
    assert changes(_manifest(), _manifest(recipe={"name": "quick"}))[0] == "recipe lean → quick"
    assert changes(_manifest(), _manifest()) == ["nothing but the file names"]
    assert changes({}, _manifest()) == ["the manifest of one of the two cannot be read"]


def test_versions_stand_in_the_order_of_their_making_with_moved_metrics() -> None:
    better = [{**_manifest()["field_metrics"][0], "value": 21.5}]

    def version(name: str, made_s: float, manifest: dict[str, Any]) -> VersionFacts:
        return VersionFacts(
            scene="street", view="left", name=name, made_s=made_s, megabytes=1.0, scans=1, images=0,
            manifest=manifest, removed="removed on 2026-11-25 by a rule" if made_s == 1e9 else "",
        )  # fmt: skip

    page = versions_html(
        [
            version("manual-2", 2e9, _manifest(field_metrics=better)),
            version("manual-1", 1e9, _manifest()),
            version("manual-<3>", 3e9, {}),
        ]
    )
    assert page.index("manual-&lt;3&gt;") < page.index("manual-2") < page.index("manual-1"), "newest first"
    assert page.index("manual-1") < page.index("removed on 2026-11-25 by a rule") and "20.00" in page
    assert "21.50 <span" in page and "▲ +1.50" in page and "the first one here" in page
