"""How a registration proceeds, when its pose is checked, what its derivative is, and how priors act.

## Phases

`register` repeats three steps: find matches at the current pose, weigh them, update the pose. It has two phases:

- The coarse phase accepts matches up to the first `max_distance`. Of 8,192 source points or more, it uses an even
  subset of at least 4,096.
- Near convergence, the fine phase takes over, with the second `max_distance` and all points that take part in the
  registration (see `max_source_points`).

## Starts that are already right

The coarse phase may leave a right `init`, for instance where clouds were cut out of merged scans. Outside `jit` and
`vmap`, its pose is therefore compared with that of a second registration from `init`, by the fine distance alone, if
there are two distances, it has moved the points by more than the fine one, and one of these holds:

- The surfaces of matched points do not coincide at the pose.
- Fewer than 60 % of the source points lie on the target.
- There are fewer than 4,000 matches, no channel constrains the pose, and it is DEGENERATE, or has moved the points by
  more than half of the coarse distance.
- The status is MAX_ITERATIONS.

With fewer than 4,000 matches there is a third registration, with 0.6 times the fine distance. The result is the pose at
which the surfaces coincide clearly better. If they do about as well at a pose further than the fine distance from it,
or if views have little in common and the other registration fails or ends elsewhere, a converged pose is UNVERIFIED,
and a warning says which `max_distance` led to which pose. Where surfaces coincide about as well, a nearer pose replaces
a DEGENERATE one, and a converged pose one after MAX_ITERATIONS.

Inside `jit` and `vmap` nothing is compared, so that a pose may be CONVERGED and wrong that is UNVERIFIED outside: pass
a small `max_distance` if `init` is near.

## Outside and inside `jit`

Outside `jit` and `vmap`, also inside `grad` or `jvp`, the loop runs on the host. It calls compiled programs whose
shapes do not depend on the sizes of the clouds, so that another size compiles nothing. Value and gradient take as long
as two to five registrations, of small clouds with channels up to eight. `register_batch` differentiates many pairs in
one call.

Inside `jit`, a registration is one program for each size of clouds, which compiles for 8 to 30 s: pad clouds to one
size by `PointCloud.pad`. `vmap`, `lax.scan`, `lax.cond`, `lax.map` and `jax.checkpoint` trace it as well, also outside
`jit`; `shard_map` needs `check_vma=False`. Matches come from host callbacks, one batch element at a time, or with
`DenseSearch` from XLA. The pose is the same up to rounding, unless that of a second registration replaces it outside.

## Derivatives

Poses have first derivatives by points, channels, given covariances, given parameters of the method and the scale of
`robust`. The derivatives by `init` and the other options are 0. Matches, neighbours and estimated parameters are
constants, as are `status`, `num_inliers` and `overlap`; `cost`, `rmse` and `covariance` raise an error in reverse mode.
The derivative is that of `estimate_pose` for the matches of the last update. To step
along a gradient, use `cloud.replace(points=...)`: a step of the whole cloud would move its `origin`, too.

Channels change a pose mostly by which points match, and α does so by this alone. Where a method matches by channels
(not with `photometric=True`), the derivative is therefore by default that of soft matches: of the root of
`estimate_pose` near the pose, over the 8 target points nearest to each source point in position and α · channel, within
the fine `max_distance`. They are weighted as in `mahalanobis_cost`, with a `temperature` of one spacing of the target
(its median nearest-neighbour distance, or the edge of its cells). This derivative approximates the change of the whole
registration over steps that move α · channel by about one spacing. For smooth changes of the channels of tables,
posters and LiDAR scans it has nearly the same direction (cosine 0.88 to 0.98) and 0.7 to 1.3 of the size
(tests/benchmarks, By channels); where channels hardly move the pose, or change by several spacings at once, it agrees
less.

With `soft_matches=False`, the derivative is the slope over tiny steps, which change no match: by channels, mostly a
hundred times too small, and of any sign. The pose, its status and all else are those of the nearest matches in either
case.

The derivative depends on the status:

- UNVERIFIED and MAX_ITERATIONS: as if the pose had converged; 0 along unconstrained directions.
- DEGENERATE: that within the constrained directions, which are constants, and 0 along the others.
- Other failures: 0, never NaN.

It is 0 as well if Newton's method finds no root near the pose, as of the soft matches of some pairs of 60 points whose
channels are noise.

## Tie points and priors

With tie points or a prior, there are two stages. The first one measures the covariance of the score of the matches; tie
points and prior act in it only along directions that they know far more precisely than the matches do. The second one
starts at its pose, and weighs matches, tie points and prior by their covariances (Hansen 1982, generalised method of
moments). It is the result, and its `covariance` and `information` include tie points and prior. They also constrain
directions that the clouds do not (`UnconstrainedDirection.constrained_by_ties`). Where they contradict the matches, the
pose is an average, and UNVERIFIED if it contradicts the prior or the tie points, as by a wrong one among these.

The covariance of a prior is that of ξ = (v, ω) in T = pose · exp(ξ), in the order and frame of
`RegistrationResult.covariance`: ξ is expressed at the origin and in the axes of the source. So a GNSS covariance Σ in
the target's axes becomes Rᵀ Σ R, and at UTM coordinates, the covariance of a pose measured at the cloud must be
transported to their origin. Give directions that are not measured a large, finite variance. Standard deviations other
than 0 count as at least 7e-6 radians (in float64 3e-10), or 7e-6 of the largest centred coordinate of the source.

A variance of 0, or any singular covariance, fixes directions, whatever the clouds say: the initial pose is moved onto
them, ξ along them stays 0, the covariance is 0 up to rounding, `directions.ties` are infinite, `information` has
nothing of the prior along them, and the clouds need not constrain them. Inside `jit`, give such a covariance as a NumPy
array. One of `jnp` is traced there: it is not checked, and its variances of 0 count as the least deviations above.

The pose is differentiable by the points of the tie points, the pose of the prior, and covariances other than 0. The
weights of the matches are constants to autodiff. Where some directions are fixed, the derivative by the pose of the
prior leaves out their change.
"""
