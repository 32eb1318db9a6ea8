"""The seed of the scenes, and meshes of a metre: a box, and one that is roughly a car."""

from sensing.mesh import TriangleMesh, extrude, merge

SEED = 7


def unit_box() -> TriangleMesh:
    return extrude([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], 0.0, 1.0)


def unit_wedge() -> TriangleMesh:
    """A box with a smaller one upon it: a car, roughly."""
    base = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
    cabin = [(-0.35, -0.45), (0.25, -0.45), (0.25, 0.45), (-0.35, 0.45)]
    return merge([extrude(base, 0.0, 0.55), extrude(cabin, 0.55, 1.0, taper=0.7)])
