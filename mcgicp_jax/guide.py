"""How a registration proceeds, when its pose is checked, what its derivative is, and how priors act.

## Phases

`register` repeats three steps: find matches at the current pose, weigh them, update the pose. It has two phases:

- The coarse phase accepts matches up to the first `max_distance`. Of 8,192 source points or more, it uses an even
  subset of at least 4,096.
- Near convergence, the fine phase takes over, with all points and the second `max_distance`.

## Starts that are already right

The coarse phase may leave a right `init`, for instance where clouds were cut out of merged scans. There is therefore a
second registration from `init`, with the fine distance alone, in these cases:

- The first one has moved the points by more than the fine distance, to a pose at which the surfaces do not coincide.
  The second one is the result if the surfaces coincide better there.
- There are fewer than 4,000 matches, no channel constrains the pose, and the first registration is DEGENERATE, or has
  moved the points by more than half of the coarse distance. If the surfaces coincide about as well at a pose nearer to
  `init`, this pose replaces a DEGENERATE one, and any other pose is UNVERIFIED.
- The first one does not converge. If the second one does, and the surfaces coincide about as well at its pose, this is
  the result, UNVERIFIED.

Inside transformations there is no second registration: pass a small `max_distance` if `init` is near.

## Outside and inside `jit`

Outside `jit` and `vmap`, also inside `grad` or `jvp`, the loop runs on the host. It calls compiled programs whose
shapes do not depend on the sizes of the clouds, so that another size compiles nothing. Value and gradient take two to
five registrations. `register_batch` differentiates many pairs in one call.

Inside `jit`, a registration is one program for each size of clouds, which compiles for some ten seconds: pad clouds to
one size by `PointCloud.pad`. Matches come from host callbacks, one batch element at a time, or with `DenseSearch` from
XLA. The pose is the same up to rounding.

## Derivatives

Poses have first derivatives by points, channels, given covariances and given parameters of the method. The derivative
by `init` is 0. Matches, neighbours and estimated parameters are constants. The derivative is that of `estimate_pose`
for the matches at the pose.

Channels change a pose mostly by which points match, and α does so by this alone. Where a method compares channels, the
derivative is therefore by default that of soft matches: of the root of `estimate_pose` near the pose, over the 8 target
points nearest to each source point in position and α · channel, within the fine `max_distance`. The `temperature` is
one spacing of the target (its median nearest-neighbour distance, or the edge of its cells). It approximates the change
of the whole registration over steps that move α · channel by about one spacing.

With `soft_matches=False`, the derivative is the slope over tiny steps, which change no match: by channels, mostly a
hundred times too small, and of any sign. The pose, its status and all else are those of the nearest matches in either
case.

The derivative depends on the status:

- UNVERIFIED and MAX_ITERATIONS: as if the pose had converged.
- DEGENERATE: exact within the constrained directions, which are constants, and 0 along the others.
- Other failures: 0, never NaN. So it is where Newton's method finds no root of the soft matches, as for some pairs of
  60 points whose channels are noise.

## Tie points and priors

With tie points or a prior, there are two registrations. The first one measures the covariance of the score of the
matches; tie points and prior act in it only along directions that they know far more precisely than the matches do. The
second one starts at its pose, and weighs matches, tie points and prior by their covariances (Hansen 1982, generalised
method of moments). It is the result, and its `covariance` and `information` include tie points and prior. They also
constrain directions that the clouds do not (`UnconstrainedDirection.constrained_by_ties`). Where they contradict the
matches, the pose is an average, and UNVERIFIED if it contradicts the prior.

The covariance of a prior is that of ξ = (v, ω) in T = pose · exp(ξ), in the order and frame of
`RegistrationResult.covariance`: ξ is expressed at the origin and in the axes of the source. So a GNSS covariance Σ in
the target's axes becomes Rᵀ Σ R, and at UTM coordinates, the covariance of a pose measured at the cloud must be
transported to their origin. Directions that are not measured have a large, finite variance. Outside `jit`, standard
deviations other than 0 count as at least 1.1e-5 radians (in float64 4.7e-10), or 1.1e-5 of the largest centred
coordinate of the source. Inside transformations, covariances are not checked.

A variance of 0, or any singular covariance, fixes directions, whatever the clouds say. They are fixed from the first
update on: ξ along them stays 0, the covariance is 0 up to rounding, `directions.ties` are infinite, `information`
leaves them out, and the clouds need not constrain them. A covariance that `jit` or `vmap` traces must be positive
definite.

The pose is differentiable by the points of the tie points, the pose of the prior, and all covariances. The weights of
the matches are constants to autodiff. Where some directions are fixed and other variances are finite, the derivative by
the pose of the prior leaves out the change of the weights.
"""
