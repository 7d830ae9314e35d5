"""Parameters of the recipe `paper` by module, written into ``docs/paper_fidelity.md``.

Run ``python -m benchmarks.paper.parameters`` after a change of the recipe or of a module; it prints the
table too.
"""

import torch

from benchmarks.common.documents import DOCS, markdown_table, write_between
from nvsf_core.fields.raydrop_unet import RaydropUnet
from nvsf_core.fields.scene_field import SceneField
from nvsf_core.recipe.paper import PaperRecipe

DOCUMENT = DOCS / "paper_fidelity.md"
_FRAMES = 64
"""Of a scene; nothing learned depends on it."""
_PARTS = {
    "encoders.0.static_hash": "LiDAR: static hash, 8 levels x 4 features, 2^19",
    "encoders.0.dynamic_hash": "LiDAR: dynamic hash, 3 planes x 8 slices",
    "encoders.0.planes": "LiDAR: K-planes, 4 scales x 8 features",
    "encoders.1.static_hash": "camera: static hash",
    "encoders.1.dynamic_hash": "camera: dynamic hash",
    "encoders.1.planes": "camera: K-planes",
    "flow.grid": "flow: hash, 16 levels x 8 features, 2^18",
    "flow.network": "flow: network",
    "density_network": "density network, shared",
    "intensity": "intensity head",
    "hit": "hit head",
    "colour": "colour head",
    "unet": "U-Net",
}


def counts(recipe: PaperRecipe) -> dict[str, int]:
    """Parameters of each part of a recipe, in the table's order; nothing is allocated for it.

    Raises:
        KeyError: A parameter belongs to no part: the table would be short of it.
    """
    with torch.device("meta"):
        generator = torch.Generator("cpu")
        field = SceneField(recipe, _FRAMES, generator)
        unet = RaydropUnet(recipe.refinement.channels, generator)
    named = [*field.named_parameters(), *((f"unet.{name}", p) for name, p in unet.named_parameters())]
    found = dict.fromkeys(_PARTS, 0)
    for name, parameter in named:
        found[next((part for part in _PARTS if name.startswith(f"{part}.")), name)] += parameter.numel()
    return found


def table() -> str:
    """The recipe's parameters as Markdown."""
    found = counts(PaperRecipe(name="paper"))
    rows = [[_PARTS[part], f"{count:,}"] for part, count in found.items()]
    rows.append(["**all**", f"**{sum(found.values()):,}**"])
    return markdown_table(["part", "parameters"], rows, "| --- | ---: |")


def main() -> None:
    """Write and print."""
    text = table()
    write_between(DOCUMENT, "parameters", text)
    print(text, end="")


if __name__ == "__main__":
    main()
