"""The options of a registration, declared and checked in one place for all functions that take them."""

from __future__ import annotations

import difflib
import inspect
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, TypedDict, cast

import numpy as np
from jax.typing import ArrayLike

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess import MIN_POINTS
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import check_integer, check_positive, is_number
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._search.base import AbstractSearch

# Maximum correspondence distance in metres, or two: for the coarse and for the fine phase.
Distance: TypeAlias = ArrayLike | tuple[ArrayLike, ArrayLike]
# Radians. Above the small cycles in which nearest-neighbour matching often ends: with real scans of 0.1 m spacing,
# these were seen to stay within 0.2 mm and 0.4 mrad. The default translation tolerance is chosen likewise.
ROTATION_TOLERANCE = 5e-4
# With every third point, mean errors were those of all points within 4 % (scans of KITTI with 34,000 points, RGB-D with
# 7,500); with every tenth, up to 36 % larger.
_MAX_SOURCE_POINTS = 10_000


@dataclass(frozen=True)
class Options:
    """Options of `register`, documented there; batches, odometry and the command line take the same ones.
    `min_coarse_distance` and `max_coarse_distance` bound the coarse `max_distance` at all scales, metres, but not below
    the fine one: how far off the initial pose may be."""

    max_distance: Distance | None = None
    max_iterations: int = 64
    translation_tolerance: ArrayLike | None = None
    rotation_tolerance: ArrayLike = ROTATION_TOLERANCE
    robust: AbstractKernel | None = None
    search: AbstractSearch | None = None
    hold_unconstrained: ArrayLike = True
    equalize_channels: bool = False
    voxel_sizes: Sequence[float] = ()
    max_source_points: int | None = _MAX_SOURCE_POINTS
    soft_matches: bool | None = None
    min_coarse_distance: float = 0.0
    max_coarse_distance: Any = np.inf

    def __post_init__(self) -> None:
        for name, number in primal(self.numbers).items():
            object.__setattr__(self, name, number)
        distances: Any = self.max_distance
        if distances is not None and np.shape(distances) != (2,):
            check_positive("max_distance", distances, "one or two positive numbers")
        elif distances is not None and is_concrete(distances):
            coarse, fine = distances
            if not (is_number(coarse) and is_number(fine) and coarse >= fine > 0):
                expected = "two positive numbers, the larger one first"
                raise ValueError(f"max_distance: expected {expected}, got {distances!r}")
        check_integer("max_iterations", self.max_iterations, 1)
        tolerances = {
            "translation_tolerance": self.translation_tolerance,
            "rotation_tolerance": self.rotation_tolerance,
        }
        for name, value in tolerances.items():
            optional = name == "translation_tolerance" and value is None
            if not optional and is_concrete(value) and not (is_number(value) and np.asarray(value) >= 0):
                raise ValueError(f"{name}: expected a number of at least 0, got {value!r}")
        classes = ("robust", AbstractKernel, "Huber(1.0)"), ("search", AbstractSearch, "KDTreeSearch()")
        for name, kind, example in classes:
            value = getattr(self, name)
            if isinstance(value, type) and issubclass(value, kind):
                raise ValueError(f"{name}: expected an object such as {example}, got the class {value.__name__}")
            if value is not None and not isinstance(value, kind):
                raise ValueError(f"{name}: expected an object such as {example}, or None, got {value!r}")
        for name in ("hold_unconstrained", "equalize_channels", "soft_matches"):
            value = getattr(self, name)
            concrete = is_concrete(value)
            if (name == "soft_matches" and value is None) or (name == "hold_unconstrained" and not concrete):
                continue
            if not concrete or np.asarray(value).dtype != bool:
                raise ValueError(f"{name}: expected True or False, got {value!r}")
        if isinstance(self.voxel_sizes, str) or np.ndim(self.voxel_sizes) != 1:
            raise ValueError(f"voxel_sizes: expected a sequence of voxel sizes in metres, got {self.voxel_sizes!r}")
        for size in self.voxel_sizes:
            check_positive("voxel_sizes", size)
        if list(self.voxel_sizes) != sorted(self.voxel_sizes, reverse=True):
            raise ValueError(f"voxel_sizes: expected the coarsest first, got {self.voxel_sizes!r}")
        if self.max_source_points is not None:
            check_integer("max_source_points", self.max_source_points, MIN_POINTS)

    @property
    def numbers(self) -> dict[str, Any]:
        """The options that may be arrays, constants to autodiff."""
        names = "max_distance", "translation_tolerance", "rotation_tolerance", "hold_unconstrained"
        return {name: getattr(self, name) for name in names}

    @property
    def has_two_distances(self) -> bool:
        """Whether the coarse and the fine `max_distance` are two numbers, given or by default."""
        return self.max_distance is None or np.shape(cast(Any, self.max_distance)) != ()

    def takes_raw(self, method: AbstractMethod, name: str) -> bool:
        """Whether the method makes its cells of the cloud "source" or "target" itself, of all points."""
        return len(self.voxel_sizes) > 0 and name in method.needs_covariances


class GivenOptions(TypedDict, total=False):
    """`Options` as keyword arguments of other functions, for editors and type checkers, which cannot derive it."""

    max_distance: Distance | None
    max_iterations: int
    translation_tolerance: ArrayLike | None
    rotation_tolerance: ArrayLike
    robust: AbstractKernel | None
    search: AbstractSearch | None
    hold_unconstrained: ArrayLike
    equalize_channels: bool
    voxel_sizes: Sequence[float]
    max_source_points: int | None
    soft_matches: bool | None


def options_of(function: Callable[..., Any], options: Any) -> Options:
    """The options of `register` given to another function; raises `TypeError` for a name that neither function has."""
    # Without the name of `**options`, which is the last one.
    names = list(dict.fromkeys([*GivenOptions.__annotations__, *list(inspect.signature(function).parameters)[:-1]]))
    for name in options.keys() - names:
        close = difflib.get_close_matches(name, names)
        hint = f"did you mean {' or '.join(close)}?" if close else f"expected one of {', '.join(sorted(names))}"
        hint = "average the clouds by preprocess(cloud, voxel_size=...)" if name == "voxel_size" else hint
        raise TypeError(f"{function.__name__}: got an unexpected argument {name!r}; {hint}")
    return Options(**options)


def check_method(method: AbstractMethod) -> None:
    if isinstance(method, type) and issubclass(method, AbstractMethod):
        raise ValueError(f"method: expected {method.__name__}(), got the class {method.__name__}")
    if not isinstance(method, AbstractMethod):
        order = "; is the order right? Clouds come first" if isinstance(method, PointCloud | np.ndarray) else ""
        raise ValueError(f"method: expected a method such as MultiChannelGICP(), got {reprlib.repr(method)}{order}")
