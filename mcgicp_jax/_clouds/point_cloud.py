"""Point clouds with channels, and frames: clouds with the pose and the time of their sensor."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import FrozenInstanceError, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, UInt8

from mcgicp_jax._clouds.columns import COLORS, arrays_of
from mcgicp_jax._clouds.depth_images import back_project
from mcgicp_jax._compute.concrete import DeferredRows, is_concrete, with_numpy_constants
from mcgicp_jax._compute.messages import check_concrete, messages_named
from mcgicp_jax._compute.size_classes import size_class
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.poses import Pose, checked_pose_matrix, rotated

if TYPE_CHECKING:
    # Array input: NumPy, JAX or any array-like, or nested lists.
    Values: TypeAlias = ArrayLike | Sequence[Any]
else:
    # Not checked at run time: `PointCloud` has better messages, and takes clouds of other libraries.
    Values = Any

# Largest magnitude of a value, in its own unit: larger ones overflow float32.
LARGEST = np.finfo(np.float32).max
# Distance from zero, in cloud sizes, beyond which the origin is kept apart in float64: float32 coordinates would lose
# more than log2(8) = 3 of their 24 significant bits.
_FAR = 8.0


def is_far(offset: Float[np.ndarray, "3"], size: float) -> bool:
    """Whether a cloud of `size` metres lies too far from zero for float32 coordinates."""
    return bool(np.linalg.norm(offset) > _FAR * size)


def _as_float(name: str, values: Any) -> Any:
    """`values` as a floating-point array. NumPy input stays NumPy: float64 is needed until the origin is subtracted."""
    if isinstance(values, jax.Array):
        if jnp.issubdtype(values.dtype, jnp.complexfloating):
            raise ValueError(f"{name}: expected real numbers, got dtype {values.dtype}")
        return values if values.dtype in (jnp.float32, jnp.float64) else values.astype(float)
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name}: expected numbers in a rectangular array, got rows of unequal length") from error
    except (TypeError, RuntimeError) as error:
        kind = type(values).__name__
        raise ValueError(
            f"{name}: expected an array, got {kind}: {error}; pass NumPy's, of torch tensor.detach().float().numpy()"
        ) from error
    if array.dtype.kind not in ("fiu" if name == "points" else "fiub"):
        raise ValueError(f"{name}: expected real numbers, got dtype {array.dtype}")
    array = array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)
    return np.where(np.ma.getmaskarray(values), np.nan, array) if np.ma.is_masked(values) else array


PLANAR_ADVICE = (
    "lift a planar scan to 3-D: stack five copies of it, about five spacings apart in z, and fix z, roll and pitch by "
    "a prior"
)


def _checked_times(times: Values) -> Any:
    values = _as_float("times", times)
    if is_concrete(values) and not np.isfinite(values).all():
        raise ValueError("times: expected finite numbers, got NaN or infinity")
    return values


def _masked(values: Any, channels: Any, channel_valid: Values | None) -> tuple[Any, Any]:
    """The values of channels, 0 where they are missing (often NaN), so that these never enter arithmetic; and
    `channel_valid` in their shape, False also where `channels` is a masked array, None if nothing is missing."""
    shape, valid = np.shape(values), cast(Any, None)
    if channel_valid is not None:
        valid = channel_valid if isinstance(channel_valid, jax.Array) else np.ma.filled(channel_valid, False)
        if valid.dtype != bool:
            raise ValueError(f"channel_valid: expected booleans, got dtype {valid.dtype}")
        if valid.shape == shape[:-1] and shape[-1] == 1:
            valid = valid[..., None]
        if valid.shape != shape:
            raise ValueError(f"channel_valid: expected shape {shape} to go with channels, got {valid.shape}")
    if np.ma.is_masked(channels):
        measured = ~np.ma.getmaskarray(channels).reshape(shape)
        valid = measured if valid is None else measured & valid
    if valid is None:
        return values, None
    xp = np if isinstance(values, np.ndarray) and isinstance(valid, np.ndarray) else jnp
    return xp.where(valid, values, 0), valid


@partial(register_dataclass, data_fields=(), meta_fields=(), drop_fields=("size", "reason"))
@dataclass(frozen=True)
class Voxels:
    """How a cloud was downsampled. An empty pytree, so that no program depends on it; copies that transformations of
    JAX make lose it.

    Attributes:
        size: edge of the voxels, metres; None if every point was kept.
        reason: why this size was chosen; "" if it was given.
    """

    size: float | None = None
    reason: str = ""

    def __str__(self) -> str:
        because = f": {self.reason}" if self.reason else ""
        return "all points" if self.size is None else f"voxels of {self.size:g} m{because}"


def _default_names(count: int) -> tuple[str, ...]:
    return tuple(f"channel_{i}" for i in range(count))


def _checked_names(names: Sequence[str] | None, count: int) -> tuple[str, ...]:
    if isinstance(names, str):
        raise ValueError(f"channel_names: expected a sequence of names, got the string {names!r}")
    names = _default_names(count) if names is None else tuple(names)
    if len(names) != count:
        raise ValueError(f"channel_names: expected {count} names, got {len(names)}")
    if len(set(names)) < count:
        raise ValueError(f"channel_names: expected different names, got {names}")
    return names


class PointCloud(eqx.Module):
    """Points with channels; a pytree whose arrays may all have leading batch dimensions.

    A cloud built from arrays is *raw*; `preprocess` returns one that is ready to register, with neighbours. Both hold
    NumPy arrays with one row per point. Quantities derived from a cloud are cached while the cloud is in use, so do
    not modify its arrays in place. To exchange values, such as channels computed by a network, use
    `cloud.replace(channels=...)`. Rows that are not `valid` are padding (see `pad`), ignored everywhere. In masked
    arrays, a masked coordinate is NaN, so that `preprocess` leaves the point out, and a masked channel is not valid.

    Attributes:
        points: (N, 3), metres, relative to `origin` (0 for raw clouds); see `coordinates`.
        channels: (N, C), in the user's unit; C may be 0.
        channel_valid: (N, C), False where the point lacks the channel, as outside a camera's view; the value there is
            0 and is ignored. None: all points have all channels.
        valid: (N,), False for padding.
        deferred_neighbors: holds the property `neighbors`, of which some rows may not be found yet.
        voxels: how the points were averaged, see `voxel_size`.
        covariances: (N, 3, 3), or None. If given, methods use them instead of computing their own: dimensionless for
            GICP and MC-GICP, m² for NDT (from `voxel_gaussians`; the scale of a kernel is then in standard deviations).
        origin: (3,) float64, metres, subtracted from the points so that float32 stays precise at large (UTM)
            coordinates; 0 otherwise.
        channel_names: C names, such as ("intensity",) or ("red", "green", "blue"); used as column names in files.
        times: (N,) when each point was measured, from 0 at the start of the scan to 1 at its end, for `deskew`; None if
            unknown.
    """

    points: Float[Array, "*batch N 3"] | Float[np.ndarray, "*batch N 3"]
    channels: Float[Array, "*batch N C"] | Float[np.ndarray, "*batch N C"]
    channel_valid: Bool[Array, "*batch N C"] | Bool[np.ndarray, "*batch N C"] | None
    valid: Bool[Array, "*batch N"] | Bool[np.ndarray, "*batch N"]
    deferred_neighbors: DeferredRows | None
    covariances: Float[Array, "*batch N 3 3"] | Float[np.ndarray, "*batch N 3 3"] | None
    origin: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"]
    voxels: Voxels
    channel_names: tuple[str, ...] = eqx.field(static=True)
    times: Float[Array, "*batch N"] | Float[np.ndarray, "*batch N"] | None
    # Methods are Python's own. equinox would bind them as pytrees, which takes 40 µs for each call.
    __getattribute__ = object.__getattribute__

    def __init__(
        self,
        points: Values,
        channels: Values | None = None,
        *,
        channel_valid: Values | None = None,
        covariances: Values | None = None,
        channel_names: Sequence[str] | None = None,
        times: Values | None = None,
    ):
        """Create a raw cloud.

        Args:
            points: (N, 3), metres: nested lists or arrays of any real dtype, NumPy or JAX; at large (UTM) coordinates
                float64 NumPy arrays, as float32 is too coarse there. Also a structured array or a table of pandas with
                the columns x, y and z, or a cloud of Open3D. Without `channels`, their other numbers become channels,
                as `io.read` says; NaN is a missing one.
            channels: (N, C), or (N,) for a single channel, in any unit; none by default.
            channel_valid: booleans in the shape of `channels`, False where a point lacks the channel; the value there
                is ignored and may be NaN. None: all points have all channels.
            covariances: (N, 3, 3), dimensionless as in GICP (1 in the tangent plane, ε along the normal), or m² as for
                NDT.
            channel_names: one name per channel; "channel_0", "channel_1", ... by default.
            times: (N,), when each point of a scan was measured, in any unit, such as seconds: the earliest is the start
                of the scan, the latest its end.

        Raises:
            ValueError: if a shape or dtype does not fit; the message names the argument.
        """
        # NumPy would stack several arrays to one.
        if isinstance(points, tuple | list) and points and getattr(points[0], "ndim", 0) == 2:
            raise ValueError(
                f"points: expected shape (N, 3), got a {type(points).__name__} of {len(points)} arrays; pass "
                "PointCloud(points, channels), or several clouds to register_batch"
            )
        points, columns, names = arrays_of(points)
        if channels is None and columns is not None:
            channels, channel_names = columns, channel_names or names
            if channel_valid is None and np.isnan(columns).any():
                channel_valid = ~np.isnan(columns)
        self.points = _as_float("points", points)
        self._check_single()
        size = self.points.shape[0]
        if channels is None:
            channels = np.zeros((size, 0), self.points.dtype)
        self.channels = _as_float("channels", channels)
        if self.channels.ndim == 1:
            self.channels = self.channels[:, None]
        if self.channels.ndim != 2 or self.channels.shape[0] != size:
            raise ValueError(f"channels: expected shape ({size}, C) to go with points, got {self.channels.shape}")
        self.channels, self.channel_valid = _masked(self.channels, channels, channel_valid)
        self.covariances = None if covariances is None else _as_float("covariances", covariances)
        if self.covariances is not None and self.covariances.shape != (size, 3, 3):
            raise ValueError(f"covariances: expected shape ({size}, 3, 3), got {self.covariances.shape}")
        self.channel_names = _checked_names(channel_names, self.channels.shape[1])
        self.times = None
        if times is not None:
            values = _checked_times(times)
            if values.shape != (size,):
                raise ValueError(f"times: expected shape ({size},) to go with points, got {values.shape}")
            # Scaled so that the earliest is 0 and the latest 1; if all are equal, all are 1.
            xp = np if isinstance(values, np.ndarray) else jnp
            first, last = xp.min(values, initial=np.inf), xp.max(values, initial=-np.inf)
            self.times = xp.where(last > first, (values - first) / xp.where(last > first, last - first, 1), 1)
        self.valid = np.ones(size, bool)
        self.deferred_neighbors = None
        self.origin = np.zeros(3)
        self.voxels = Voxels()

    @classmethod
    def from_depth(
        cls,
        depth: Values,
        intrinsics: Values,
        color: Values | None = None,
        *,
        scale: int | float | None = None,
        max_depth: int | float | None = None,
    ) -> PointCloud:
        """Create a raw cloud from a depth image: one point per pixel with a depth, row by row.

        Args:
            depth: (height, width), distances along the optical axis. Pixels that are 0, negative, NaN or infinite, or
                65535 in an image of 16 bits, have no depth and give no point.
            intrinsics: (fx, fy, cx, cy) or the (3, 3) camera matrix, pixels; the centre of the first pixel is (0, 0).
            color: image of the same size, aligned pixel by pixel: (height, width, 3) becomes the channels red, green
                and blue, (height, width) the channel intensity. Whole numbers are scaled to 0..1.
            scale: depth units per metre; by default 1000 for whole numbers (millimetres), 1 for floating point.
            max_depth: metres; points further away are left out. None: all are kept.

        Returns:
            The cloud in the frame of the camera: x right, y down, z ahead; float32, float64 if `depth` is.

        Raises:
            ValueError: if a shape, dtype or number does not fit; the message names the argument.
        """
        points, pixels = back_project(depth, intrinsics, scale, max_depth)
        points = points if np.asarray(depth).dtype == np.float64 else points.astype(np.float32)
        if color is None:
            return cls(points)
        image, shape = np.asarray(color), np.shape(depth)
        if image.shape not in (shape, (*shape, 3)):
            raise ValueError(f"color: expected shape {shape} or {(*shape, 3)} to go with depth, got {image.shape}")
        column, row = pixels.astype(int).T
        values = image[row, column]
        if values.dtype.kind in "iu":
            values = (values / np.iinfo(values.dtype).max).astype(points.dtype)
        return cls(points, values, channel_names=COLORS if image.ndim == 3 else ("intensity",))

    def replace(self, **arrays: Any) -> PointCloud:
        """Return a copy with the given fields replaced (`points`, `channels`, `covariances`, ...).

        `channels` may be (N,) for a single one; an existing `channel_valid` applies to them, too. `points` are relative
        to `origin`, `times` from 0 to 1. `neighbors` stay as they were, constants to autodiff: after moves comparable
        to the spacing, preprocess again.

        Raises:
            ValueError: if a field does not exist, or a shape or dtype does not fit the cloud.
        """
        fields = dict(vars(self))
        unknown = arrays.keys() - fields.keys()
        if unknown:
            # Neighbours and voxels are those of `preprocess`.
            names = ", ".join(name for name in fields if name not in ("deferred_neighbors", "voxels"))
            advice = "; preprocess(cloud) finds neighbors" if "neighbors" in unknown else ""
            raise ValueError(f"replace: unknown field {', '.join(sorted(unknown))}; expected {names}{advice}")
        shapes = {name: np.shape(fields[name]) for name in ("points", "valid", "origin")}
        shapes |= {"covariances": (*shapes["points"], 3), "times": shapes["valid"]}
        channels: Any = arrays.get("channels")
        if arrays.get("times") is not None:
            arrays["times"] = _checked_times(arrays["times"])
        if "origin" in arrays:
            arrays["origin"] = _as_float("origin", arrays["origin"])
        if "valid" in arrays:
            present = arrays["valid"] if isinstance(arrays["valid"], jax.Array) else np.asarray(arrays["valid"])
            if present.dtype != bool:
                raise ValueError(f"valid: expected booleans, got dtype {present.dtype}")
            arrays["valid"] = present
        for name in ("points", "channels", "covariances"):
            if arrays.get(name) is not None:
                array, dtype = _as_float(name, arrays[name]), self.points.dtype
                # JAX warns of conversions to float64 where it has none.
                dtype = dtype if isinstance(array, np.ndarray) else jax.dtypes.canonicalize_dtype(dtype)
                # Of traced arrays, even a conversion to the same dtype would be compiled.
                array = array if array.dtype == dtype else array.astype(dtype)
                single = name == "channels" and array.ndim < np.ndim(self.points)
                arrays[name] = array[..., None] if single else array
        if np.ma.is_masked(channels):
            valid = arrays.get("channel_valid", self.channel_valid)
            _, arrays["channel_valid"] = _masked(arrays["channels"], channels, valid)
        for name, value in arrays.items():
            expected = shapes.get(name, np.shape(value))
            if np.shape(value) != expected and not (name in ("covariances", "times") and value is None):
                raise ValueError(f"{name}: expected shape {expected}, got {np.shape(value)}")
        if "channels" in arrays:
            channels = arrays["channels"]
            if np.shape(channels)[:-1] != np.shape(self.points)[:-1]:
                raise ValueError(f"channels: expected shape ({self.points.shape[-2]}, C), got {np.shape(channels)}")
            if channels.shape[-1] != self.channels.shape[-1] and "channel_names" not in arrays:
                arrays["channel_names"] = _default_names(channels.shape[-1])
        fields |= arrays
        if "channel_names" in arrays:
            fields["channel_names"] = _checked_names(arrays["channel_names"], fields["channels"].shape[-1])
        if fields["channel_valid"] is not None and arrays.keys() & {"channels", "channel_valid"}:
            channels = fields["channels"]
            fields["channels"], fields["channel_valid"] = _masked(channels, channels, fields["channel_valid"])
        return self.replace_rows(**fields)

    @property
    def neighbors(self) -> Int[Array, "*batch N k"] | Int[np.ndarray, "*batch N k"] | None:
        """(N, k) rows of the k nearest points, nearest first, including the point itself; −1 where there are fewer.

        None for raw clouds. `preprocess` leaves the search to the first use of each row; reading this finds the rest.
        """
        return None if self.deferred_neighbors is None else self.deferred_neighbors.whole

    @property
    def voxel_size(self) -> float | None:
        """Edge of the voxels in which `preprocess` averaged the points, metres; None if it kept all points, and for raw
        clouds and copies made by transformations of JAX."""
        return self.voxels.size

    @property
    def coordinates(self) -> Float[np.ndarray, "*batch N 3"]:
        """Positions in the user's frame, (N, 3) float64, metres: `points` + `origin`."""
        return np.asarray(self.points, np.float64) + np.asarray(self.origin, np.float64)[..., None, :]

    def __len__(self) -> int:
        """The number of points, without padding."""
        return int(np.count_nonzero(self.valid))

    def __repr__(self) -> str:
        # Leaves may be no arrays, as after `jax.eval_shape` or `jax.tree.map`.
        if not isinstance(self.points, np.ndarray | jax.Array):
            return f"PointCloud(points={self.points!r}, channels={self.channels!r})"
        if not is_concrete(self) or self.points.ndim != 2:
            size = f"shape {tuple(self.points.shape[:-1])}"
        elif len(self) == self.points.shape[0]:
            size = f"{len(self)} points"
        else:
            size = f"{len(self)} points padded to {self.points.shape[0]}"
        names = list(self.channel_names)
        if self.channel_valid is not None and is_concrete(self) and self.points.ndim == 2:
            fractions = np.mean(np.asarray(self.channel_valid)[np.asarray(self.valid)], axis=0)
            names = [f"{name} ({fraction:.0%})" for name, fraction in zip(names, fractions, strict=True)]
        parts = [size, f"channels: {', '.join(names) or 'none'}", str(self.points.dtype)]
        if self.deferred_neighbors is not None:
            parts.append(f"{self.deferred_neighbors.shape[-1]} neighbors")
        if self.voxel_size is not None:
            parts.append(str(self.voxels))
        if is_concrete(self.origin) and np.any(self.origin):
            parts.append(f"origin {np.array2string(np.asarray(self.origin), precision=1)}")
        return f"PointCloud({', '.join(parts)})"

    def _check_single(self) -> None:
        shape, advice = self.points.shape, ""
        if len(shape) == 2 and shape[1] == 3:
            return
        if len(shape) == 2 and shape[0] == 3:
            advice = "; pass points.T"
        elif len(shape) == 3 and shape[2] == 3:
            advice = "; pass points.reshape(-1, 3) of one cloud in a grid, or a list of clouds to register_batch"
        elif len(shape) == 2 and shape[1] == 2:
            advice = f"; {PLANAR_ADVICE}"
        elif len(shape) == 2 and shape[1] > 3:
            advice = "; pass PointCloud(points, channels)"
        raise ValueError(f"points: expected shape (N, 3), got {shape}{advice}")

    def unpad(self) -> PointCloud:
        """Return the valid rows as a raw cloud: NumPy arrays in the user's frame, float64 if `origin` is not 0.

        Raises:
            ValueError: if the cloud is traced or a batch.
        """
        check_concrete("cloud", self)
        self._check_single()
        valid = np.asarray(self.valid)
        # A plain copy takes a tenth of the time of `compress`, and that a quarter of boolean indexing.
        valid_rows: Any = np.array if valid.all() else partial(np.compress, valid, axis=0)
        arrays = {name: getattr(self, name) for name in ("channels", "channel_valid", "covariances", "times")}
        arrays["points"] = self.coordinates if np.any(self.origin) else self.points
        arrays = {name: None if array is None else valid_rows(np.asarray(array)) for name, array in arrays.items()}
        # The constructor's other checks hold already.
        arrays |= {"valid": np.ones(len(arrays["points"]), bool), "origin": np.zeros(3)}
        return self.replace_rows(**arrays, deferred_neighbors=None, voxels=Voxels())

    def crop(self, min_range: float = 0.0, max_range: float = np.inf) -> PointCloud:
        """Return the valid points of a cloud in its sensor's frame whose distance from the sensor lies in a range, as a
        raw cloud. The nearest returns are often from the sensor's own vehicle or holder, which moves with it.

        Args:
            min_range, max_range: metres, inclusive.

        Raises:
            ValueError: if `min_range` is negative or larger than `max_range`, or the cloud is traced.
        """
        if not 0 <= min_range <= max_range:
            raise ValueError(f"min_range: expected 0 to max_range = {max_range}, got {min_range}")
        check_concrete("cloud", self)
        ranges = np.linalg.norm(self.coordinates, axis=-1)
        inside = np.asarray(self.valid) & (ranges >= min_range) & (ranges <= max_range)
        return self.replace_rows(valid=inside).unpad()

    def pad(self, size: int | None = None) -> PointCloud:
        """Append padding rows until the cloud has `size` rows.

        Inside your own `jax.jit`, clouds padded to the same size share one compiled program. Padding repeats the last
        point, so that features of all rows, such as x / z or the logarithm of a channel, and their derivatives are
        finite; no other function reads it.

        Args:
            size: number of rows; by default the smallest of 128, 192, 256, 384, 512, ... that holds the cloud.

        Raises:
            ValueError: if the cloud has more than `size` rows, or is a batch.
        """
        self._check_single()
        size = size_class(self.points.shape[0]) if size is None else size
        missing = size - self.points.shape[0]
        if missing < 0:
            raise ValueError(f"size: expected at least {self.points.shape[0]}, the rows of the cloud, got {size}")

        def grow(array: Any, fill: int | None = None) -> Any:
            if array is None:
                return None
            fill = 0 if fill is None and not len(array) else fill
            if not isinstance(array, np.ndarray):
                options: dict[str, Any] = {"mode": "edge"} if fill is None else {"constant_values": fill}
                return jnp.pad(array, [(0, missing)] + [(0, 0)] * (array.ndim - 1), **options)
            # Takes a tenth of the time of `np.pad`.
            grown = np.empty((size, *array.shape[1:]), array.dtype)
            grown[: len(array)], grown[len(array) :] = array, array[-1] if fill is None else fill
            return grown

        arrays = {name: grow(getattr(self, name)) for name in ("points", "channels", "covariances", "times")}
        arrays |= {name: grow(getattr(self, name), False) for name in ("channel_valid", "valid")}
        neighbors = grow(self.neighbors, -1)
        return self.replace_rows(**arrays, deferred_neighbors=None if neighbors is None else DeferredRows.of(neighbors))

    def replace_rows(self, **arrays: Any) -> PointCloud:
        """Replace fields without checks; the number of rows may change."""
        cloud = object.__new__(PointCloud)
        for name, value in (vars(self) | arrays).items():
            object.__setattr__(cloud, name, value)
        return cloud

    @with_settings_of_package
    def transform(self, pose: Pose) -> PointCloud:
        """Transform the cloud by a pose: points p become R p + t, covariances C become R C Rᵀ.

        If the result lies far from zero, a raw cloud gets float64 points; a preprocessed one keeps its dtype and
        changes its `origin`, so read `coordinates`.

        Args:
            pose: `jaxlie.SE3` or (4, 4), translation in metres.

        Raises:
            ValueError: if a concrete pose is no rigid motion or has another shape, or the cloud is a batch.
        """
        self._check_single()
        matrix = checked_pose_matrix(pose, "pose")
        xp = np if isinstance(self.points, np.ndarray) and is_concrete(matrix) else jnp
        rotation = xp.asarray(matrix[:3, :3], self.points.dtype)
        points = rotated(np.asarray(self.points), rotation) if xp is np else self.points @ rotation.T
        covariances = None if self.covariances is None else rotation @ self.covariances @ rotation.T
        offset = matrix[:3, :3] @ self.origin + matrix[:3, 3]
        far = is_concrete(points, offset) and is_far(np.asarray(offset), float(np.abs(points).max(initial=0)))
        if far and self.deferred_neighbors is None:
            moved = rotated(self.coordinates, np.asarray(matrix[:3, :3], np.float64)) + np.asarray(matrix[:3, 3])
            return self.replace_rows(points=moved, covariances=covariances, origin=np.zeros(3))
        if far:
            # The large offset stays in float64.
            return self.replace(points=points, covariances=covariances, origin=np.asarray(offset, np.float64))
        points = points + xp.asarray(offset, points.dtype)
        return self.replace(points=points, covariances=covariances, origin=xp.zeros_like(self.origin))

    @staticmethod
    def stack(clouds: Sequence[PointCloud]) -> PointCloud:
        """Stack clouds along a new leading batch dimension for `jax.vmap`, padded as `pad()` pads the largest.

        Raises:
            ValueError: if there are no clouds, or they differ in channels, number of neighbours or covariances.
        """
        if not clouds:
            raise ValueError("clouds: expected at least one, got none")
        clouds = [as_cloud(f"clouds[{i}]", cloud) for i, cloud in enumerate(clouds)]
        size = max(size_class(cloud.points.shape[0]) for cloud in clouds)

        def kind(cloud: PointCloud) -> str:
            neighbors = 0 if cloud.deferred_neighbors is None else cloud.deferred_neighbors.shape[-1]
            covariances = "no covariances" if cloud.covariances is None else "covariances"
            return f"the channels {cloud.channel_names}, {neighbors} neighbors and {covariances}"

        for i, cloud in enumerate(clouds):
            if kind(cloud) != kind(clouds[0]):
                raise ValueError(f"clouds[{i}]: expected {kind(clouds[0])}, got {kind(cloud)}")
        if any(cloud.channel_valid is not None for cloud in clouds):
            masks = [np.ones(cloud.channels.shape, bool) for cloud in clouds]
            clouds = [
                cloud.replace(channel_valid=mask) if cloud.channel_valid is None else cloud
                for cloud, mask in zip(clouds, masks, strict=True)
            ]
        if any(cloud.times is None for cloud in clouds):
            clouds = [cloud.replace_rows(times=None) for cloud in clouds]
        padded = [cloud.pad(size) for cloud in clouds]
        xp = np if is_concrete(padded) else jnp
        return jax.tree.map(lambda *rows: xp.stack([xp.asarray(row) for row in rows]), *padded)


_set_field = PointCloud.__setattr__


def _set_or_advise(cloud: PointCloud, name: str, value: Any) -> None:
    try:
        _set_field(cloud, name, value)
    except FrozenInstanceError as error:
        raise FrozenInstanceError(f"{name}: clouds are immutable; use the copy cloud.replace({name}=...)") from error


# Modules of equinox must not define it in their body.
PointCloud.__setattr__ = _set_or_advise  # type: ignore[assignment,method-assign]


def as_cloud(name: str, cloud: PointCloud | Values) -> PointCloud:
    if not isinstance(cloud, PointCloud):
        with messages_named(name):
            cloud = PointCloud(cloud)
    # Most clouds hold NumPy arrays, and are asked for several times in a registration.
    in_numpy = isinstance(cloud.points, np.ndarray) and isinstance(cloud.channels, np.ndarray)
    mixed = isinstance(cloud.channel_valid, jax.Array) or isinstance(cloud.covariances, jax.Array)
    return cloud if in_numpy and not mixed else with_constants(cloud)


def with_constants(cloud: PointCloud) -> PointCloud:
    constant = with_numpy_constants(cloud)
    # Pytrees do not have the voxels of a cloud.
    return cloud if constant is cloud else constant.replace_rows(voxels=cloud.voxels)


def check_several(name: str, clouds: object) -> None:
    if isinstance(clouds, str | os.PathLike):
        reader = f"mcgicp_jax.datasets.clouds({str(clouds)!r})"
        raise ValueError(f"{name}: expected a sequence of clouds, got a path; {reader} reads those of a folder")
    if isinstance(clouds, PointCloud | Frame) or getattr(clouds, "ndim", None) == 2:
        raise ValueError(f"{name}: expected a sequence of clouds, got one {type(clouds).__name__}; pass a list")


def same_channels(one: PointCloud, other: PointCloud) -> bool:
    """Whether two clouds have equally many channels of the same names; default names match any."""
    count, names = one.channels.shape[-1], (one.channel_names, other.channel_names)
    return other.channels.shape[-1] == count and (names[0] == names[1] or _default_names(count) in names)


@dataclass(frozen=True, eq=False)
class Frame:
    """A cloud with the pose and the time of the sensor.

    The true relative pose of two frames is `T_target_source = inv(target.pose) @ source.pose`.

    Attributes:
        cloud: in the sensor's frame, metres.
        pose: (4, 4), sensor to world, metres; None if unknown.
        time: seconds from an arbitrary start; None if unknown.
        image: (height, width, 3) red, green and blue from 0 to 255; None if there is none.
        pixels: (N, 2) column and row of each point in the image, NaN where it is outside; None without an image.
    """

    cloud: PointCloud
    pose: Float[np.ndarray, "4 4"] | None = None
    time: float | None = None
    image: UInt8[np.ndarray, "height width 3"] | None = None
    pixels: Float[np.ndarray, "N 2"] | None = None
