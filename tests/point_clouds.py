"""What a LiDAR would see of cars, and of the ground around them."""

import numpy as np
import numpy.typing as npt

from protocol.geometry import SE3

Floats32 = npt.NDArray[np.float32]
SENSOR_HEIGHT_M = 3.0


def car_shell(
    pose: npt.ArrayLike, sensor: tuple[float, float], rng: np.random.Generator, points: int = 300
) -> Floats32:
    """Returns points (N, 3), map frame, on the roof and on the sides that face the sensor."""
    length_m, width_m, height_m = 4.5, 1.8, 1.5
    map_se3_car = SE3.from_pose(pose)
    x, y, _ = map_se3_car.inverse().apply(np.array([[*sensor, SENSOR_HEIGHT_M]]))[0]
    local = rng.uniform(-0.5, 0.5, (points, 3)) * [length_m, width_m, height_m]
    local[:, 2] += height_m / 2
    face = rng.integers(0, 3, points)
    local[face == 0, 2] = height_m
    local[face == 1, 0] = np.sign(x) * length_m / 2
    local[face == 2, 1] = np.sign(y) * width_m / 2
    if abs(x) < length_m / 2:  # the sensor stands abreast and sees neither end
        local = local[face != 1]
    if abs(y) < width_m / 2:
        local = local[face[: len(local)] != 2]
    return map_se3_car.apply(local).astype(np.float32)


def ground_points(rng: np.random.Generator, climb: float = 0.0, count: int = 40_000) -> Floats32:
    """Returns points (N, 3) on and beside the road, denser near the junction, with undulation."""
    x = rng.normal(0, 70, count).clip(-300, 200)
    y = rng.uniform(-15, 15, count)
    z = climb * x + 0.08 * np.sin(x / 9) * np.cos(y / 7) + rng.normal(0, 0.02, count)
    return np.column_stack([x, y, z]).astype(np.float32)
