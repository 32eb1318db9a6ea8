"""Reflectivity of surfaces: how much laser light returns, and from what range it is detected.

The power that returns from a surface larger than the beam goes with its reflectivity, with the
cosine of the angle of incidence where it is smooth (Lambert's law), and with 1 / range^2 (Jelalian
1992, Laser Radar Systems). A data sheet states the range at which a target of 10 % at right angles
is detected; any other surface is detected as far as it returns that power. Asphalt and leaves are
rough: they send back about as much at any angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints32
from protocol.messages import Material
from sensing.mesh import TriangleMesh
from sensing.noise import stream

TARGET = 0.1  # reflectivity of a data sheet's dark target
SURE = 0.9  # share of its returns that are detected at the range that is stated
STEEPNESS = 20.0  # of the detection's fall around that range: from 90 % to 10 % over a fifth; ours
MIN_RANGE_M = 0.5

# At 905 nm; ours, of what is usual. A vehicle's paint is drawn.
PAINTED = -1.0
_OF_MATERIALS = {
    Material.PAINT: PAINTED,
    Material.GLASS: 0.0,  # rays pass: such triangles are left out
    Material.RUBBER: 0.05,
    Material.METAL: 0.3,
    Material.RETROREFLECTOR: 3.0,  # sends back more than any diffuse surface
    Material.CLOTH: 0.4,
}
# Of vehicles: half are white or silver, a third black or dark (carbon black takes the infrared,
# too), others in between; means and spread of the logarithm. Ours, after paint makers' surveys.
_PAINTS = ((0.5, 0.6, 0.2), (0.33, 0.07, 0.3), (0.17, 0.3, 0.3))
_PAINT_LIMITS = 0.03, 0.85
MEAN_PAINT = 0.4  # where no paint is given


@lru_cache(maxsize=1 << 16)
def paint_of(seed: int, vehicle: str) -> float:
    """Returns the reflectivity of a vehicle's paint; it follows from the seed and its id."""
    rng = stream(seed, "paint", vehicle)
    shares = np.cumsum([share for share, _, _ in _PAINTS])
    _, mean, spread = _PAINTS[int(np.searchsorted(shares, rng.random() * shares[-1]))]
    return float(np.clip(mean * np.exp(spread * rng.standard_normal()), *_PAINT_LIMITS))


def paints_of(seed: int, vehicles: Sequence[str]) -> Floats32:
    """Returns the reflectivity of the paint of each vehicle (N,)."""
    return np.array([paint_of(seed, name) for name in vehicles], np.float32)


class Surfaces:
    """The triangles of a mesh as a laser meets them.

    Attributes:
        normals: unit vectors (T, 3) in the mesh's frame.
        reflectivity: (T,), `PAINTED` where it is that of the body's paint.
        power: (T, 4) what comes back is |x, y, z times the ray's direction| + w: the normal by the
            reflectivity where Lambert's law holds, the reflectivity alone where it does not.
    """

    def __init__(self, mesh: TriangleMesh, reflectivity: Floats32, smooth: Floats32) -> None:
        """Takes the mesh; of its triangles (T,) reflectivity, and 1 where Lambert's law holds."""
        a, b, c = mesh.corners.astype(np.float64).transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals: Floats32 = (normals / np.maximum(length, 1e-12)).astype(np.float32)
        self.reflectivity = reflectivity
        lambertian = self.normals * (reflectivity * smooth)[:, None]
        self.power: Floats32 = np.column_stack([lambertian, reflectivity * (1 - smooth)])


def without_glass(mesh: TriangleMesh) -> TriangleMesh:
    """Returns the mesh of a vehicle without its windows, through which rays pass."""
    opaque = mesh.materials != Material.GLASS
    return TriangleMesh(mesh.vertices, mesh.triangles[opaque], mesh.materials[opaque])


def of_vehicle(mesh: TriangleMesh) -> Surfaces:
    """Returns the surfaces of a vehicle's mesh by its materials; all of them are smooth."""
    table = np.array([_OF_MATERIALS[one] for one in sorted(Material)], np.float32)
    reflectivity = table[mesh.materials]
    return Surfaces(mesh, reflectivity, np.ones(len(reflectivity), np.float32))


@njit(
    "void(float32[::1], int32[::1], float32[:,::1], float32[:,::1], float32, float32[::1])",
    cache=True,
)
def static_strength(
    distance_m: Floats32,
    faces: Ints32,
    directions: Floats32,
    power: Floats32,
    range_m: float,
    strength: Floats32,
) -> None:
    """Writes the power (N,), see `Surfaces`, that rays along unit directions (3, N) bring back."""
    for ray in range(distance_m.size):
        strength[ray] = np.float32(0)
        if distance_m[ray] < range_m:
            face = np.uint64(faces[ray])
            lit = power[face, 0] * directions[0, ray] + power[face, 1] * directions[1, ray]
            lit += power[face, 2] * directions[2, ray]
            strength[ray] = abs(lit) + power[face, 3]


@njit(
    "void(float32[::1], int32[::1], float32[::1], int32[::1], int32[::1], float32[::1], "
    "int32[::1], float32[:,::1], float64[:,:,::1], float32[:,::1], float32[::1], float32[::1])",
    cache=True,
)
def keep_nearest_lit(  # noqa: PLR0913, PLR0917 - compiled code takes its arrays one by one
    range_m: Floats32,
    hit: Ints32,
    strength: Floats32,
    beams: Ints32,
    owners: Ints32,
    found_m: Floats32,
    faces: Ints32,
    directions: Floats32,
    placed: Floats,
    normals: Floats32,
    reflectivity: Floats32,
    paint: Floats32,
) -> None:
    """Lowers the range of each beam to what was found, notes the body and how it reflects.

    Directions (3, N) and normals are in the mesh's frame, which `placed` (see `candidates.place`)
    maps the sensor's into: the normal in the sensor's frame is the map's transpose times it.
    """
    for k in range(found_m.size):
        beam = beams[k]
        if found_m[k] >= range_m[beam]:
            continue
        range_m[beam], hit[beam] = found_m[k], owners[k]
        face, body = faces[k], owners[k]
        along, square = 0.0, 0.0
        for axis in range(3):
            along += normals[face, axis] * directions[axis, k]
        for k_sensor in range(3):
            part = 0.0
            for axis in range(3):
                part += placed[body, 9 + k_sensor, axis] * normals[face, axis]
            square += part * part
        cosine = abs(along) / np.sqrt(max(square, 1e-12))
        value = reflectivity[face] if reflectivity[face] >= 0 else paint[body]
        if along > 0:  # from within: seats and dark trim behind tinted glass take the light
            value = np.float32(0)
        strength[beam] = np.float32(value * min(cosine, 1.0))


@njit(
    "void(float32[::1], float32[::1], float32[::1], float32[::1], float32[::1], float32[::1], "
    "float64[::1])",
    cache=True,
)
def apply_power(
    distance_m: Floats32,
    strength: Floats32,
    draw: Floats32,
    noise: Floats32,
    range_m: Floats32,
    intensity: Floats32,
    rates: Floats,
) -> None:
    """Writes range (N,), 0 for none, and intensity: the strength, as calibrated sensors report it.

    `rates` are the farthest range, the share that returns whatever is hit, the range of the 10 %
    target, the noise's standard deviation, and the air's extinction, 1/m.
    """
    farthest, keep, dark_m, stddev, extinction = rates
    middle = 1.0 + np.log(SURE / (1.0 - SURE)) / STEEPNESS
    near, far_gone = (middle - 8.0 / STEEPNESS) ** 2, (middle + 8.0 / STEEPNESS) ** 2
    weakening = TARGET / (dark_m * dark_m)
    for n in range(distance_m.size):
        range_m[n] = intensity[n] = np.float32(0)
        if strength[n] <= 0 or not MIN_RANGE_M <= distance_m[n] < farthest:
            continue
        far = distance_m[n] * distance_m[n] * weakening / strength[n]  # of its range, squared
        if extinction > 0:
            far *= np.exp(2.0 * extinction * distance_m[n])
        chance = keep
        if far > far_gone:
            continue
        if far > near:  # nearer, all of them are detected
            chance = keep / (1.0 + np.exp(STEEPNESS * (np.sqrt(far) - middle)))
        if draw[n] < chance:
            range_m[n] = max(distance_m[n] + noise[n] * stddev, MIN_RANGE_M)
            intensity[n] = min(strength[n], np.float32(1))
