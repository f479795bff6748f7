"""Cases from the tests and pages of other libraries: raw clouds and all defaults here, beside what they publish.

    python -m tests.benchmarks.other_libraries

The folder `other_libraries` of `MCGICP_DATA` has their files: `pcl/bun0.pcd`, `pcl/bun4.pcd` (`test/` of PCL),
`libpointmatcher/car_cloud400.csv`, `car_cloud401.csv` (`examples/data`), and `simpleicp/bunny_part1.xyz`,
`bunny_part2.xyz`, `dragon1.xyz`, `dragon2.xyz` (`data`). Each line has a published bound, our figure in the same
unit, and whether it is within the bound. The data of simpleICP and of PCL's ICP have a published pose, whose figure on
these data is the bound.

- matrix: largest difference of an entry of the pose, as a fraction of the tolerance of PCL's test;
- fitness: PCL's `getFitnessScore`, the mean squared distance from source points to their nearest target points, m²;
- length, angle: differences of the translation's length and of the rotation, metres and radians, as libpointmatcher
  compares them;
- truth: root mean square distance of the source points from where the truth of PCL's test of PPF has them, metres;
- residual: standard deviation of the distances from the target's planes of 10 neighbours, as simpleICP reports it, in
  units of the clouds; without those beyond 3 deviations, from the median.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from tests.benchmarks.accuracy import DATA

FOLDER = DATA / "other_libraries"


def pose_of(rotation: Any, translation: Any) -> np.ndarray:
    return np.vstack([np.column_stack([rotation, translation]), [0, 0, 0, 1]])


# PCL's test of IterativeClosestPoint, and the tolerance of each entry there.
ICP = pose_of(
    [[0.8806, 0.036481, -0.4724], [-0.02354, 0.9992, 0.03326], [0.4732, -0.01817, 0.8808]],
    [0.03453, -0.001519, 0.04116],
)
ICP_TOLERANCE = np.where(np.arange(12) == 1, 1e-2, 1e-3).reshape(3, 4)
# The truth of PCL's test of PPFRegistration, the motion of the source there, and the tolerance.
PPF = pose_of([[0.825336, 0, -0.564642], [0, 1, 0], [0.564642, 0, 0.825336]], [0.037267, 0, 0.038325])
PPF_AXIS = np.array([0.354, 0.878, -0.806])
PPF_MOTION = pose_of(
    Rotation.from_rotvec(-1.627 * PPF_AXIS / np.linalg.norm(PPF_AXIS)).as_matrix(), [-0.515, 0.260, -0.845]
)
PPF_TOLERANCE = 0.1
# The motion of the target in PCL's test of GeneralizedIterativeClosestPoint, which is also the initial pose.
GUESS = pose_of(Rotation.from_euler("XYZ", [45, 90, 59.4], degrees=True).as_matrix(), [0.1, 0.2, 0.3])
# libpointmatcher's utest, "from visual inspection".
CAR = pose_of(
    [[0.982304, 0.166685, -0.0854066], [-0.150189, 0.973488, 0.172524], [0.111899, -0.156644, 0.981296]],
    [0.0446816, 0.191998, -0.0356313],
)
# Outputs on the pages of simpleICP.
SIMPLE_BUNNY = pose_of(
    [[0.984798, -0.173702, -0.000053], [0.173702, 0.984798, 0.000084], [0.000038, -0.000092, 1]],
    [0.000676, -0.001150, 0.000113],
)
SIMPLE_DRAGON = pose_of(
    [[0.998696, 0.052621, -0.034179], [-0.052090, 0.999028, 0.020119], [0.034822, -0.018663, 0.999436]],
    [-0.206737, -0.408088, -0.593361],
)

# Maps pose (4, 4), source and target (n, 3) to our figure.
Measure = Callable[[np.ndarray, np.ndarray, np.ndarray], float]


class Case(NamedTuple):
    """One line of the table.

    Attributes:
        files: of source and target.
        measures: by name, the function and the published bound, or the published pose.
        moves: motions of source and target before registration.
    """

    name: str
    files: tuple[str, str]
    measures: dict[str, tuple[Measure, Any]]
    method: Callable[[], mcg.AbstractMethod] = mcg.GICP
    options: dict[str, Any] | None = None
    moves: tuple[np.ndarray, np.ndarray] = (np.eye(4), np.eye(4))


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def fitness(pose: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    return float(np.mean(cKDTree(target).query(moved(source, pose))[0] ** 2))


def entries(published: np.ndarray, tolerance: Any) -> Measure:
    return lambda pose, source, target: float(np.max(np.abs(pose[:3] - published[:3]) / tolerance))


def truth(pose: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((moved(source, pose) - moved(source, PPF)) ** 2, axis=1))))


def residual(pose: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    tree = cKDTree(target)
    distances, near = tree.query(target, 10)
    apart = target[near] - target[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(apart.swapaxes(1, 2) @ apart)[1][:, :, 0]
    nearest, rows = tree.query(moved(source, pose))
    # Only where the clouds overlap: within five spacings.
    some = nearest < 5 * np.median(distances[:, 1])
    residuals = np.sum((moved(source, pose) - target[rows]) * normals[rows], axis=1)[some]
    apart = np.abs(residuals - np.median(residuals))
    # 1.4826: a median of absolute deviations as a standard deviation.
    return float(residuals[apart < 3 * 1.4826 * np.median(apart)].std())


def length(pose: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    return abs(float(np.linalg.norm(pose[:3, 3]) - np.linalg.norm(CAR[:3, 3])))


def angle(pose: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    return float(Rotation.from_matrix(CAR[:3, :3].T @ pose[:3, :3]).magnitude())


BUN = ("pcl/bun0.pcd", "pcl/bun4.pcd")
CARS = ("libpointmatcher/car_cloud401.csv", "libpointmatcher/car_cloud400.csv")
PARTS = ("simpleicp/bunny_part2.xyz", "simpleicp/bunny_part1.xyz")
DRAGONS = ("simpleicp/dragon2.xyz", "simpleicp/dragon1.xyz")
OF_ICP = {"truth": (truth, ICP)}
OF_CAR = {"length": (length, 0.1), "angle": (angle, 0.1)}
OF_PARTS = {"residual": (residual, SIMPLE_BUNNY)}
OF_DRAGONS = {"residual": (residual, SIMPLE_DRAGON)}
OF_PPF = entries(PPF @ np.linalg.inv(PPF_MOTION), PPF_TOLERANCE)
CASES = [
    Case(
        "PCL, ICP, its max_distance",
        BUN,
        {"matrix": (entries(ICP, ICP_TOLERANCE), 1)},
        mcg.PointToPoint,
        {"max_distance": 0.05},
    ),
    Case("PCL, ICP", BUN, OF_ICP, mcg.PointToPoint),
    Case("PCL, point-to-plane", BUN, {"fitness": (fitness, 0.005)}, mcg.PointToPlane),
    Case("PCL, GICP", BUN, {"fitness": (fitness, 1e-4)}),
    Case(
        "PCL, GICP from a guess", BUN, {"fitness": (fitness, 1e-4)}, options={"init": GUESS}, moves=(np.eye(4), GUESS)
    ),
    Case("PCL, NDT", BUN, {"fitness": (fitness, 1e-3)}, mcg.NDT, {"voxel_sizes": (0.025,)}),
    Case(
        "PCL, PPF, then GICP", BUN, {"matrix": (OF_PPF, 1)}, options={"init": "global"}, moves=(PPF_MOTION, np.eye(4))
    ),
    Case("libpointmatcher, car, GICP", CARS, OF_CAR),
    Case("libpointmatcher, car, point-to-plane", CARS, OF_CAR, mcg.PointToPlane),
    Case("simpleICP, bunny, GICP", PARTS, OF_PARTS),
    Case("simpleICP, bunny, point-to-plane", PARTS, OF_PARTS, mcg.PointToPlane),
    Case("simpleICP, dragon, GICP", DRAGONS, OF_DRAGONS),
    Case("simpleICP, dragon, point-to-plane", DRAGONS, OF_DRAGONS, mcg.PointToPlane),
]


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    warnings.simplefilter("ignore")
    print(f"{'case':38} {'measure':8} {'published':>10} {'ours':>10}  holds  status")
    for case in CASES:
        given = (np.asarray(mcg.io.read(FOLDER / file).coordinates, np.float64) for file in case.files)
        source, target = map(moved, given, case.moves)
        result = mcg.register(source, target, case.method(), **(case.options or {}))
        for name, (measure, bound) in case.measures.items():
            figure = measure(np.asarray(result.matrix, np.float64), source, target)
            bound = measure(bound, source, target) if np.ndim(bound) else bound
            holds = "yes" if figure <= bound else "no"
            print(f"{case.name:38} {name:8} {bound:10.2g} {figure:10.2g}  {holds:5}  {result.status.name}", flush=True)


if __name__ == "__main__":
    main()
