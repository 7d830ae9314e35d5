"""A scan from where nobody drove: ``python examples/own_view.py SCENE RECIPE LEFT_M FOLDER``.

The scene is trained if it was not yet; its middle instant is rendered that many metres to the left of the
recorded path, as a data set in the folder, with PLY files.
"""

import sys

from nvsf_core.stages import find_scene
from nvsf_core.stages.render_view import render_view

if __name__ == "__main__":
    scene, recipe, left_m, folder = sys.argv[1:]
    entry = find_scene(scene)
    middle = (entry.first_frame + entry.last_frame) // 2
    view = {"name": "mine", "shift_m": [0.0, float(left_m), 0.0], "frames": [middle], "exports": ["ply"]}
    print(f"frame {middle}, {left_m} m to the left: {render_view(entry, view, out=folder, recipe=recipe)}")
