"""The drives that nobody tuned on are real drives of a catalogue, each what its name says."""

import numpy as np

from benchmarks.tables.other_drives import OTHER_DRIVES, main, write_drives
from benchmarks.tables.targets import OTHER
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.drive import has_data
from nvsf_core.drives.kitti360.layout import DriveLayout

STANDING, STREET = f"{OTHER}standing", f"{OTHER}street"


def test_a_catalogue_names_the_drives_and_what_is_there_is_not_written_again(tmp_path):
    catalogue = write_drives(tmp_path / "drives", [STANDING, STREET], DemoSize.tiny())
    scenes = load_catalogue([catalogue], None)
    assert {scene.name for scene in scenes} == {STANDING, STREET} and all(map(has_data, scenes))
    travelled_m = {}
    for scene in scenes:
        places = np.loadtxt(DriveLayout(scene.root, DEMO_SEQUENCE).poses_path)[:, [4, 8, 12]]
        travelled_m[scene.name] = float(np.linalg.norm(places[-1] - places[0]))
    assert travelled_m[STANDING] < 1e-6 and travelled_m[STREET] > 2.0
    poses = DriveLayout(scenes[0].root, DEMO_SEQUENCE).poses_path
    before = poses.stat().st_mtime_ns
    write_drives(tmp_path / "drives", [STANDING, STREET], DemoSize.tiny())
    assert poses.stat().st_mtime_ns == before


def test_an_unknown_drive_is_named_beside_those_that_there_are(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("NVSF_HOME", str(tmp_path))
    monkeypatch.setenv("SCENES", f"{STREET} nowhere")
    assert main() == 2
    said = capsys.readouterr().err
    assert "no such drives: nowhere" in said and all(name in said for name in OTHER_DRIVES)
