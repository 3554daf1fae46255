"""What several readers make of the rest, where a data set does not publish it."""

from pytest_cpas.types import Derived

BY_CATEGORY = Derived(
    part="symmetry",
    made_of=frozenset({"category"}),
    how="the paper's, by category: bottle, bowl and can about y, others none",
)

BOX_OF_MESH = Derived(
    part="extents", made_of=frozenset({"mesh"}), how="the side lengths of the mesh's box"
)

RENDERED = Derived(
    part="mask",
    made_of=frozenset({"mesh", "pose", "depth"}),
    how="the mesh rendered at its pose, less what was measured more than 1 cm in front of it",
)

PROJECTED = Derived(
    part="2-D box",
    made_of=frozenset({"pose", "extents"}),
    how="the projected box, where the ground truth has none; there is no image",
)
