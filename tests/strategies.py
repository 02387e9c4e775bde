"""What tests draw from: rotations near nothing and near pi, poses, cameras, rigs. One file, used everywhere."""

import numpy as np
from closed_form import VergingRig
from hypothesis import strategies as st

from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig

SIZE = (1280, 720)

#: One ordinary camera of each model; the lenses are strong enough that a wrong term shows.
CAMERAS = {
    "none": Camera(SIZE, "none", np.array([900.0, 905.0, 650.0, 350.0]), np.zeros(0)),
    "brown4": Camera(SIZE, "brown4", np.array([900.0, 905.0, 650.0, 350.0]), np.array([-0.25, 0.09, 1e-3, -7e-4])),
    "brown5": Camera(
        SIZE, "brown5", np.array([900.0, 905.0, 650.0, 350.0]), np.array([-0.3, 0.12, 1e-3, -7e-4, -0.02])
    ),
    "brown8": Camera(
        SIZE,
        "brown8",
        np.array([900.0, 905.0, 650.0, 350.0]),
        np.array([0.3, -0.1, 1e-3, -7e-4, 0.01, 0.6, -0.05, 0.02]),
    ),
    "fisheye": Camera(SIZE, "fisheye", np.array([500.0, 503.0, 650.0, 350.0]), np.array([0.03, -0.01, 4e-3, -1e-3])),
}


def finite(low: float, high: float) -> st.SearchStrategy[float]:
    """Floats of a closed interval."""
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


def vectors(low: float, high: float, n: int = 3) -> st.SearchStrategy[np.ndarray]:
    """(n,) arrays of an interval."""
    return st.lists(finite(low, high), min_size=n, max_size=n).map(np.array)


def directions() -> st.SearchStrategy[np.ndarray]:
    """(3,) unit vectors."""
    return vectors(-1, 1).filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))


def angles() -> st.SearchStrategy[float]:
    """Angles of 0 to pi, crowded at both ends where formulas break."""
    tiny = finite(-12, -1).map(lambda e: 10.0**e)
    return st.one_of(finite(0, np.pi), st.just(0.0), tiny, tiny.map(lambda a: np.pi - a))


@st.composite
def rotation_vectors(draw, largest: float = np.pi) -> np.ndarray:
    """(3,) rotation vectors, near nothing and near ``largest`` too."""
    return draw(directions()) * min(draw(angles()), largest)


def rotations() -> st.SearchStrategy[np.ndarray]:
    """(3, 3) rotations."""
    return rotation_vectors().map(exp_so3)


@st.composite
def poses(draw, reach: float = 2.0) -> np.ndarray:
    """(4, 4) poses."""
    return pose(draw(rotations()), draw(vectors(-reach, reach)))


@st.composite
def verging_rigs(draw) -> VergingRig:
    """Cameras as in the method's setup, unequal and anywhere a table top would have them."""
    return VergingRig(
        F1=draw(finite(2e-3, 16e-3)),
        F2=draw(finite(2e-3, 16e-3)),
        beta1=draw(finite(0.02, 0.5)),
        beta2=draw(finite(0.02, 0.5)),
        X01=draw(finite(0.05, 0.3)),
        X02=draw(finite(0.05, 0.3)),
        Y01=draw(finite(-0.05, 0.05)),
        Y02=draw(finite(-0.05, 0.05)),
        Z01=draw(finite(-0.1, 0.1)),
        Z02=draw(finite(-0.1, 0.1)),
    )


#: x (1 - 0.3 x^2) never exceeds 0.703 at x = 1.054: a pixel further out than that belongs to no ray.
FOLDING = Camera(SIZE, "brown4", np.array([500.0, 500, 640, 360]), np.array([-0.3, 0.0, 0.0, 0.0]))


def folding_rig() -> StereoRig:
    """Return two cameras side by side of which outer pixels have no ray."""
    return StereoRig(FOLDING, FOLDING, pose(np.eye(3), np.array([0.1, 0, 0])), np.zeros((22, 22)), 0.1)


def ordinary_rig(model: str = "brown5", seed: int = 0) -> StereoRig:
    """Return a rig with a full covariance, numbers that use every digit, and a provenance."""
    rng = np.random.default_rng(seed)
    base = CAMERAS[model]
    left, right = (
        base.with_parameters(base.parameters * (1 + 1e-3 * rng.normal(size=base.parameters.size))) for _ in "lr"
    )
    T_left_right = pose(exp_so3(np.array([0.013, -0.21, 0.007])), np.array([0.2191, 0.0032, 0.0187]))
    n = left.parameters.size + right.parameters.size + 6
    root = 1e-3 * rng.normal(size=(n, n))
    return StereoRig(left, right, T_left_right, root @ root.T, 0.137, {"command": "test", "pairs": 7})
