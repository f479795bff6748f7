"""Whether a status is a promise: scenes whose registrations were once CONVERGED and wrong, and scenes that must stay.

    python -m tests.benchmarks.promises [--seeds 8] [--groups starts ...] [--cases NAME ...]

Each row counts registrations by what they say. right: CONVERGED and within the noise of the points; honest: another
status, or deviations that cover the error; false: CONVERGED, and further off than the deviations allow.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from tests.benchmarks.accuracy import DATA, consecutive, road, table
from tests.promise_scenes import (
    MOVING_CHANNELS,
    NOISE,
    SCENES,
    STEP,
    Channel,
    Pair,
    box,
    in_frames,
    office,
    on_vehicle,
    seen,
    stairs,
    tiles,
    translation,
    views,
)
from tests.scenes import motion

# Errors in deviations that a right covariance exceeds in one of a million registrations (six degrees of freedom: 37).
_DEVIATIONS = 6.0
# Metres: a smaller error is right, whatever the deviations say.
_RIGHT = 2 * NOISE


class Case(NamedTuple):
    """One row: `run` registers the clouds of a seed."""

    group: str
    name: str
    run: Callable[[int], tuple[mcg.RegistrationResult, np.ndarray]]


def registered(pair: Pair, method: Any, **options: Any) -> tuple[mcg.RegistrationResult, np.ndarray]:
    """The result of a registration, and the true pose."""
    return mcg.register(pair.source, pair.target, method, **options), pair.T_target_source


def verdict(result: mcg.RegistrationResult, truth: np.ndarray) -> str:
    """right, honest or false: see above. The error is that of the centroid of the matched points and of the rotation,
    the latter at the distance of one radius."""
    if result.status != mcg.Status.CONVERGED:
        return "honest"
    change = np.linalg.inv(truth) @ np.asarray(result.matrix, np.float64)
    center = np.asarray(result.directions.center, np.float64)
    angle = np.arccos(np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1))
    shift = np.linalg.norm(change[:3, :3] @ center + change[:3, 3] - center)
    error = max(float(shift), float(angle * result.directions.radius))
    deviations = np.asarray(result.deviations)
    allowed = max(np.linalg.norm(deviations[:3]), np.linalg.norm(deviations[3:]) * float(result.directions.radius))
    if error <= _RIGHT:
        return "right"
    return "honest" if error <= _DEVIATIONS * allowed else "false"


# A start off by a few centimetres and degrees; and a frame far from the clouds, turned about two axes.
_NEAR = motion((0.03, -0.04, 0.02, 0.01, -0.02, 0.02))
_FRAME = motion((15.0, 8.0, -2.0, 0.3, 0.0, 2.0))


def start_cases() -> Iterator[Case]:
    """A start that is right is left; narrow kernels stay at a wrong one; stairs end a step off, a known limit."""
    prior = np.diag(np.r_[[0.05**2] * 3, [np.deg2rad(1) ** 2] * 3])
    starts: dict[str, dict[str, Any]] = {
        "truth": {},
        "near": {"init": _NEAR},
        "global": {"init": "global"},
        "prior": {"prior": (np.eye(4), prior)},
    }
    for count in (330, 500, 1000, 2000, 4000, 8000):
        for name, options in starts.items():
            yield case(f"office, {count:,} points, from {name}", partial(office, count=count), mcg.GICP(), options)
    for common in (0.67, 0.5):
        for name in ("truth", "near", "prior"):
            words = f"office, {100 * common:.0f} % in common, from {name}"
            yield case(words, partial(office, common=common), mcg.GICP(), starts[name])
    yield case("office, point-to-plane, from truth", office, mcg.PointToPlane(), {})
    yield case("office, MC-GICP, from truth", with_tiles, mcg.MultiChannelGICP(), {})
    for cells in (mcg.NDT(), mcg.D2DNDT()):
        yield case(f"office, {type(cells).__name__}, from truth", office, cells, {"voxel_sizes": (0.5,)})

    def framed(seed: int) -> Pair:
        return in_frames(office(seed), _FRAME, _FRAME)

    yield case("office, in another frame, from truth", framed, mcg.GICP(), {"init": np.eye(4)})
    for kernel in (mcg.Tukey, mcg.Welsch, mcg.GemanMcClure):
        yield case(f"room, {kernel.__name__}(0.05), from 0.19 m", room, mcg.GICP(), {"robust": kernel(0.05)})
    for (field, turn, apart), start in itertools.product(
        ((1.6, 1.1, 0.5), (2.2, 1.1, 0.5), (1.6, 0.8, 0.5), (1.6, 1.1, 1.5)), ("identity", "truth")
    ):
        words = f"views of {np.degrees(field):.0f}°, {np.degrees(turn):.0f}° and {apart} m apart, from {start}"
        yield Case("starts", words, partial(from_start, partial(views, field=field, turn=turn, apart=apart), start))
    yield case("stairs, from 0.3 m (a limit)", stairs, mcg.GICP(), {})
    yield case("stairs, from global", stairs, mcg.GICP(), {"init": "global"})


def case(name: str, scene: Callable[[int], Pair], method: mcg.AbstractMethod, options: dict[str, Any]) -> Case:
    return Case("starts", name, lambda seed: registered(scene(seed), method, **options))


def from_start(scene: Callable[[int], Pair], start: str, seed: int) -> tuple[mcg.RegistrationResult, np.ndarray]:
    pair = scene(seed)
    return registered(pair, mcg.GICP(), init=pair.T_target_source if start == "truth" else None)


def with_tiles(seed: int) -> Pair:
    """The office with a channel of random tiles."""
    pair, value = office(seed), tiles(0.05)
    clouds = (
        cloud.replace(channels=value(np.zeros(0), np.asarray(cloud.points, np.float64))[:, None].astype(np.float32))
        for cloud in pair[:2]
    )
    return Pair(*clouds, pair.T_target_source)


def room(seed: int) -> Pair:
    target, source = datasets.box_room(2, seed=seed)
    return Pair(source.cloud, target.cloud, np.linalg.inv(target.pose) @ source.pose)


def beside_tiles(channel: Channel, amplitude: float) -> Channel:
    """A channel multiplied by the reflectance of tiles."""
    reflectance = tiles(amplitude)
    return lambda points, world: channel(points, world) * (1 + reflectance(points, world))


def evidence_cases() -> Iterator[Case]:
    """Channels that move with the sensor, alone and beside a texture, in three frames; and what must stay right."""
    turned = translation(15, 8, 3)
    turned[:3, :3] = Rotation.from_rotvec([0.4, 0.5, 1.0]).as_matrix()
    still = np.eye(4)
    frames = {"": (still, still), ", both clouds moved": (turned, turned), ", target moved": (still, turned)}

    def run(make: Callable[[int], Pair], start: Any, seed: int) -> Any:
        return registered(make(seed), mcg.MultiChannelGICP(), init=start)

    def pattern(sides: Any, channel: Channel, step: float, frame: Any, seed: int) -> Pair:
        return in_frames(seen(sides, seed, channel, step=step), *frame)

    for (scene, sides), (where, frame) in itertools.product(SCENES.items(), frames.items()):
        start = frame[1] @ np.linalg.inv(frame[0])
        for step, rest in ((STEP, ""), (0.0, ", at rest")):
            make = partial(pattern, sides, tiles(0.05, 1.0), step, frame)
            yield Case("evidence", f"{scene}, tiles alone{where}{rest}", partial(run, make, start))
        for (name, channel), amplitude in itertools.product(MOVING_CHANNELS.items(), (0, 0.02, 0.05, 0.1)):
            make = partial(pattern, sides, beside_tiles(channel, amplitude), STEP, frame)
            beside = f", tiles ± {amplitude:.0%}" if amplitude else ""
            yield Case("evidence", f"{scene}, {name}{beside}{where}", partial(run, make, start))

    def nth(pairs: Callable[[], Iterator[Any]], seed: int) -> Any:
        every = list(pairs())
        pair = every[seed % len(every)]
        return registered(Pair(pair.source, pair.target, pair.truth), mcg.MultiChannelGICP(), init=pair.start)

    def simulated(frames_of: Any, seed: int) -> Any:
        return nth(lambda: consecutive(frames_of(2, seed=seed)), 0)

    for name, frames_of in {
        "posters": datasets.poster_wall,
        "rooms": datasets.box_room,
        "street": datasets.street,
    }.items():
        yield Case("evidence", name, partial(simulated, frames_of))
    sets: dict[str, Callable[[], Iterator[Any]]] = {
        "KITTI": partial(consecutive, datasets.kitti(DATA / "kitti/sequences/04")),
        "table, flat": partial(table, "_flat"),
        "7-Scenes": partial(consecutive, datasets.seven_scenes(DATA / "sevenscenes_redkitchen")),
        "KITTI, bare road": road,
    }
    for name, pairs in sets.items():
        yield Case("evidence", name, partial(nth, pairs))


def vehicle_cases() -> Iterator[Case]:
    """Returns from the sensor's own vehicle, where nothing else constrains a direction; and what must stay right."""
    frames = {"": np.eye(4), ", target moved": _FRAME}
    cabinet = box((1.5, 0.2, 0), (2.3, 1, 2), lid=False)

    def run(scene: Callable[[int], Pair], fraction: float, method: mcg.AbstractMethod, frame: Any, seed: int) -> Any:
        pair = in_frames(on_vehicle(scene(seed), seed, fraction), np.eye(4), frame)
        if method.uses_channels:
            # Channels that are nothing but noise.
            rng = np.random.default_rng(seed)
            clouds = (cloud.replace(channels=rng.normal(size=(cloud.valid.size, 1))) for cloud in pair[:2])
            pair = Pair(*clouds, pair.T_target_source)
        return registered(pair, method, init=frame)

    methods = mcg.GICP(), mcg.PointToPlane(), mcg.MultiChannelGICP()
    own = itertools.product(("corridor", "floor and wall"), (0.01, 0.02, 0.05, 0.1), methods, frames.items())
    for name, fraction, method, (where, frame) in own:
        words = f"{name}, {fraction:.0%} own vehicle, {type(method).__name__}{where}"
        yield Case("vehicle", words, partial(run, partial(seen, SCENES[name]), fraction, method, frame))
    for name, scene in {
        "room": room,
        "corridor with a cabinet": partial(seen, [*SCENES["corridor"], *cabinet]),
    }.items():
        for fraction in (0.0, 0.02):
            words = f"{name}, {fraction:.0%} own vehicle"
            yield Case("vehicle", words, partial(run, scene, fraction, mcg.GICP(), np.eye(4)))


GROUPS: dict[str, Callable[[], Iterator[Case]]] = {
    "starts": start_cases,
    "evidence": evidence_cases,
    "vehicle": vehicle_cases,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--groups", nargs="*", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--cases", nargs="*", default=[], help="words of which a row's name has at least one")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| scene | right | honest | false |\n|---|---|---|---|")
    total = 0
    for case in (case for group in arguments.groups for case in GROUPS[group]()):
        if arguments.cases and not any(word in case.name for word in arguments.cases):
            continue
        counts = Counter(verdict(*case.run(seed)) for seed in range(arguments.seeds))
        total += counts["false"]
        print(f"| {case.name} | {counts['right']} | {counts['honest']} | {counts['false']} |", flush=True)
    print(f"\n{total} false")
    sys.exit(min(total, 1))


if __name__ == "__main__":
    main()
