"""The objective of one segment: how badly the rest after a motion fits the filled signal (paper A, Eq. 15-18).

A segment is departure (a known state) → moving samples, no row → arrival (rest samples). Two closed forms make
f(δ) cheap and exact; the sample-by-sample filter is their oracle in the tests:

1. The moving samples collapse into one transition, and what lies between saturated samples does so once for all δ.
2. The arrival is a fixed quadratic. In the body frame at arrival the rest samples are the same whatever δ is;
   only the velocity and the direction of gravity on arrival depend on it. With m = [θ, v̂ + v_e] and γ = [g; 1]
   in that frame, the rows of the rest cost ½ [m; γ]ᵀ Λ [m; γ], and Λ is built once per recording.

The minimum over m with the arriving covariance P needs no inverse of P, so singular priors are fine. With
Λ = [G; K][G; K]ᵀ + [0, 0; 0, C], w = Gᵀm + Kᵀγ at the mean and λ = G(I + GᵀPG)⁻¹w,
f = ½ |Gᵀx + Kᵀγ|² + ½ γᵀCγ + ½ λᵀPλ at x = m − Pλ. (Solved for with Λ_mm itself, λ is a difference of numbers so
large that the gradient is rounded hundreds of times as much.)
λ is also the slope of f in m, and −½λλᵀ that in P: at the inner minimum only the direct dependence counts.
"""

from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.components import Cholesky, Matrix, Quaternion, Scalar, Vector
from jaxsat.inertial.dense import eigh
from jaxsat.inertial.preintegration import Passage, Stretch, passage, stretches
from jaxsat.inertial.strapdown import NavState
from jaxsat.saturation.gap_shapes import Edges
from jaxsat.saturation.prior import Known

# The smoother's order is [θ, r, v]; here position comes last, so that it can be left out.
_POSITION_LAST = np.array([0, 1, 2, 6, 7, 8, 3, 4, 5])


class Segment(eqx.Module):
    """One motion between two rests, padded: n moving samples, m saturated values."""

    signal: Float[Array, "n 6"]
    """As measured, from the departure sample on (rad/s, m/s²)."""
    period: Float[Array, "n"]
    """Sampling period; zero pads (s)."""
    variance: Float[Array, "n 2"]
    """Per-sample noise variance of a gyroscope and of an accelerometer axis."""
    cut: Int[Array, "M"]
    """Samples with a saturated value, ascending; n pads."""
    element: Int[Array, "m"]
    """Which of `cut` a saturated value belongs to."""
    channel: Int[Array, "m"]
    """Which channel."""
    sign: Float[Array, "m"]
    """Direction of the rail: the true value is signal + sign·δ with 0 ≤ δ ≤ bound; zero pads."""
    bound: Float[Array, "m"]
    """δ_b (rad/s or m/s²)."""
    start: Float[Array, "m"]
    """δ to begin with; zeros where nothing better is known."""
    gap: Int[Array, "m"]
    """Which of the segment's gaps a saturated value belongs to."""
    edges: Edges
    """Edges of each gap, time in samples of the segment; padded."""
    departure: NavState
    """State at the start of sample 0."""
    departure_covariance: Float[Array, "s s"]
    """Of [θ, r, v], or of [θ, v] where heights are not used."""
    arrival: Float[Array, "10 10"]
    """Λ over [m (6), γ (4)]; zeros where no rest follows."""
    height: Bool[Array, ""] | None
    """Whether the arrival is at height zero; None where heights are not used at all."""
    height_variance: Float[Array, ""]
    known: Known | None = None
    """What the signal prior says of δ, for the method `map`."""


class Condensed(eqx.Module):
    """A segment as f(δ) sees it: saturated samples, and before each a stretch that does not depend on δ.

    One blank sample ends the last stretch. Vectors are in the body frame at departure.
    """

    stretches: Stretch
    """M+1 of them."""
    signal: Float[Array, "6 M1"]
    period: Float[Array, "M1"]
    variance: tuple[Float[Array, "M1"], Float[Array, "M1"]]
    element: Int[Array, "m"]
    channel: Int[Array, "m"]
    sign: Float[Array, "m"]
    place: Int[Array, "6 M1"]
    """Which of the saturated values each sample of `signal` is; m for none."""
    velocity: Vector
    """At departure."""
    height: Float[Array, ""]
    """At departure."""
    up: Vector
    """Unit."""
    covariance: Matrix
    """At departure, of [θ, v], with position [θ, v, r]."""
    arrival: Matrix
    """Λ."""
    root: Matrix
    """G of Λ_mm = G Gᵀ."""
    cross: Matrix
    """K of Λ_mγ = G Kᵀ."""
    own: Matrix
    """C = Λ_γγ − K Kᵀ: what γ costs with the best m."""
    height_row: tuple[Bool[Array, ""], Float[Array, ""]] | None
    """Whether there is one, and its variance."""


def condense(segment: Segment) -> Condensed:
    """All that f(δ) needs and δ does not change; done once per segment."""
    n = len(segment.period)
    position = segment.height is not None
    is_cut = jnp.zeros(n, bool).at[segment.cut].set(True, mode="drop")
    before, last = stretches(segment.signal, segment.period, segment.variance, is_cut, position)
    # A blank cut has an empty stretch before it, and the blank end what follows the last cut.
    blank = Stretch.empty(position, segment.period[0])
    parts = jax.tree.map(
        lambda x, end, empty: jnp.append(
            jnp.where(segment.cut < n, x[jnp.minimum(segment.cut, n - 1)], empty), end
        ),
        before,
        last,
        blank,
    )

    def pick(x):
        return jnp.concatenate([x.at[segment.cut].get(mode="fill", fill_value=0), jnp.zeros_like(x[:1])])

    to_body = Quaternion.of(segment.departure.q_nb).conjugate()
    R = Matrix.block([[to_body.matrix()]])
    P = segment.departure_covariance
    if len(P) == 9:
        P = P[_POSITION_LAST][:, _POSITION_LAST]
    size = 9 if position else 6
    P = Matrix.of(P[:size, :size])
    values, vectors = eigh(segment.arrival[:6, :6])
    root = jnp.sqrt(jnp.maximum(values, 0.0))
    # Of what the rest does not see, turns about gravity, Λ_mγ is rounding.
    seen = values > 1e-14 * values[-1]
    inverse = jnp.where(seen, 1.0 / jnp.where(seen, root, 1.0), 0.0)
    cross = segment.arrival[6:, :6] @ (vectors * inverse[None])
    one = jnp.ones_like(segment.height_variance)
    variance = pick(segment.variance)
    # Saturated values come sample by sample, channel by channel, those that pad last.
    count, ends = len(segment.sign), 6 * (len(segment.cut) + 1)
    element, channel = segment.element.astype(int), segment.channel.astype(int)
    order = jnp.where(segment.sign != 0.0, 6 * element + channel, ends)
    asked = jnp.arange(ends).reshape(-1, 6).T
    first = jnp.searchsorted(order, asked)
    place = jnp.where(jnp.append(order, ends)[first] == asked, first, count)
    return Condensed(
        stretches=parts,
        signal=pick(segment.signal).T,
        period=pick(segment.period),
        variance=(variance[:, 0], variance[:, 1]),
        element=segment.element,
        channel=segment.channel,
        sign=segment.sign,
        place=place,
        velocity=to_body.rotate(Vector.of(segment.departure.velocity)),
        height=segment.departure.position[2],
        up=R(Vector(0.0, 0.0, one)),
        covariance=_turned(R, _turned(R, P).T).mirrored(),
        arrival=Matrix.of(segment.arrival),
        root=Matrix.of(vectors * root[None]),
        cross=Matrix.of(cross),
        own=Matrix.of(segment.arrival[6:, 6:] - cross @ cross.T),
        height_row=None if segment.height is None else (segment.height, segment.height_variance),
    )


def _turned(R: Matrix, columns: Matrix) -> Matrix:
    """Each vector of some columns turned by R."""
    return Matrix.block(
        [[R @ columns.part(slice(i, i + 3), slice(None))] for i in range(0, len(columns.rows), 3)]
    )


def _compensated(condensed: Condensed, delta: Float[Array, "m"]) -> Float[Array, "6 M1"]:
    """ȳ = y + s·δ (Eq. 17). Picked by its place, since to add to places takes a CPU a loop over all of them."""
    return condensed.signal + jnp.append(condensed.sign * delta, 0.0)[condensed.place]


def _pass(condensed: Condensed, signal: Float[Array, "6 M1"]) -> Passage:
    """The motion with a compensated signal."""
    return passage(
        condensed.stretches,
        Vector(*signal[:3]),
        Vector(*signal[3:]),
        condensed.period,
        condensed.variance,
    )


class _Arrival(eqx.Module):
    """What a filled signal brings to the rest; vectors in the body frame there."""

    velocity: Vector
    gravity: Vector
    """Its reaction: upwards."""
    height: Array | float
    turn: Matrix
    """Takes vectors from the body frame at departure to that at arrival."""


def _arrive(condensed: Condensed, motion: Passage, gravity: Float[Array, ""]) -> _Arrival:
    """The state that the strapdown gives."""
    tau, fall = motion.duration, condensed.up * gravity
    turn = motion.rotation.conjugate().matrix()
    height = 0.0
    if condensed.height_row is not None:
        moved = condensed.velocity * tau + motion.levers[1] - fall * (0.5 * tau**2)
        height = condensed.height + condensed.up.dot(moved)
    return _Arrival(turn(condensed.velocity + motion.levers[0] - fall * tau), turn(fall), height, turn)


def _covariance(condensed: Condensed, motion: Passage) -> Matrix:
    """Of [θ, v] or [θ, v, r] after the motion, in the body frame at departure."""
    identity, zero = Matrix.identity(3), Matrix.identity(3, 0.0)
    rows = [[identity, zero, zero], [-Matrix.skew(motion.levers[0]), identity, zero]]
    if len(motion.levers) == 2:
        rows.append([-Matrix.skew(motion.levers[1]), Matrix.identity(3, motion.duration), identity])
    transition = Matrix.block([row[: len(rows)] for row in rows])
    return (transition @ condensed.covariance @ transition.T).mirrored() + motion.noise_covariance()


class _Inner(eqx.Module):
    """The inner minimum at one δ."""

    value: Array
    slope: Matrix
    """λ, the slope of f in m."""
    lean: Matrix
    """The slope of f in γ."""
    height_slope: Array | float
    """κ, the slope of f in the height on arrival."""
    met: Matrix
    """[x; γ], what the rest sees at the minimum."""
    root: Matrix
    """B with B Bᵀ = Λ_mm(I + PΛ_mm)⁻¹, the curvature of f in m."""


def _inner(condensed: Condensed, motion: Passage, at: _Arrival) -> _Inner:
    """Minimise over the error of the state on arrival, in closed form."""
    P = _covariance(condensed, motion)
    theta, change, cost = Vector(0.0, 0.0, 0.0), Vector(0.0, 0.0, 0.0), 0.0
    gain, weight = Matrix.column((0.0,) * 9), 0.0
    if condensed.height_row is not None:
        active, variance = condensed.height_row
        row = Matrix.column((0.0,) * 6 + tuple(condensed.up))
        gain = P @ row
        s = jnp.where(active, (row.T @ gain)[0, 0] + variance, 1.0)
        weight = jnp.where(active, 1.0 / s, 0.0)
        pulled = [-g * (weight * at.height) for g in gain.entries()]
        theta, change = Vector(*pulled[:3]), Vector(*pulled[3:6])
        P = (P - gain @ gain.T * weight).mirrored()
        cost = 0.5 * weight * at.height**2
    mean = Matrix.column((*at.turn(theta), *(at.velocity + at.turn(change))))
    gamma = Matrix.column((*at.gravity, jnp.ones_like(condensed.height)))
    P = P.part(slice(6), slice(6))
    # Turning G to the frame of P is cheaper than turning P to that of G.
    root = _turned(at.turn.T, condensed.root)
    inner = Cholesky((Matrix.identity(6) + root.T @ (P @ root)).mirrored())
    pull = condensed.cross.T @ gamma
    slope = root @ inner.solve(condensed.root.T @ mean + pull)
    correction = P @ slope
    conditioned = mean - _turned(at.turn, correction)
    # Summed up at the minimiser, so that an error of λ counts in second order only.
    misfit, left = condensed.root.T @ conditioned + pull, condensed.own @ gamma
    value = cost + 0.5 * (misfit.T @ misfit + gamma.T @ left + slope.T @ correction)[0, 0]
    height_slope = 0.0
    if condensed.height_row is not None:
        height_slope = weight * (at.height - (gain.part(slice(6), slice(1)).T @ slope)[0, 0])
    return _Inner(
        value=cast(Array, value),
        slope=_turned(at.turn, slope),
        lean=condensed.cross @ misfit + left,
        height_slope=height_slope,
        met=Matrix(conditioned.rows + gamma.rows),
        root=inner.forward(condensed.root.T).T,
    )


def _pulled(
    signal: Float[Array, "6 M1"], condensed: Condensed, gravity: Float[Array, ""], inner: _Inner
) -> Scalar:
    """A function of the compensated signal with the slope of f where `inner` was taken (envelope theorem).

    λ·m + lean·γ + κ·z + ½ [x; γ]ᵀΛ[x; γ] − ½ λᵀPλ − ½ κ²σ² with what multiplies m, γ, z, Λ, P and σ² held: what P
    says along one direction needs no matrix.
    """
    motion = _pass(condensed, signal)
    at = _arrive(condensed, motion, gravity)
    slope, lean = inner.slope.entries(), inner.lean.entries()
    back = at.turn.T
    turn, push = back(Vector(*slope[:3])), back(Vector(*slope[3:]))
    pull = (push,)
    V = motion.levers[0]
    known = [turn + V.cross(push), push]
    if condensed.height_row is not None:
        lift = condensed.up * inner.height_slope
        pull = (push, lift)
        known = [known[0] + motion.levers[1].cross(lift), push + lift * motion.duration, lift]
    start = Matrix.column(sum((tuple(v) for v in known), ()))
    spread = (start.T @ condensed.covariance @ start)[0, 0] + motion.noise_along(turn, pull)
    if condensed.height_row is not None:
        spread = spread + inner.height_slope**2 * condensed.height_row[1]
    return (
        at.velocity.dot(Vector(*slope[3:]))
        + at.gravity.dot(Vector(*lean[:3]))
        + inner.height_slope * at.height
        + 0.5 * (inner.met.T @ condensed.arrival @ inner.met)[0, 0]
        - 0.5 * spread
    )


def value_and_root(
    delta: Float[Array, "m"], condensed: Condensed, gravity: Float[Array, ""]
) -> tuple[Float[Array, ""], tuple[Float[Array, "m"], ...], tuple[Float[Array, "m"], ...]]:
    """f(δ) of Eq. 18, columns of A with A Aᵀ its Gauss-Newton Hessian, and what each δ does to [θ, v] at arrival."""
    motion = _pass(condensed, _compensated(condensed, delta))
    at = _arrive(condensed, motion, gravity)
    inner = _inner(condensed, motion, at)
    effect = _effect(condensed, motion, at)
    return inner.value, _root(effect, inner), cast(tuple[Array, ...], effect.entries())


def value_gradient_root(
    delta: Float[Array, "m"], condensed: Condensed, gravity: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, "m"], tuple[Float[Array, "m"], ...]]:
    """f(δ), its gradient, and the columns of A as of `value_and_root`."""
    signal = _compensated(condensed, delta)
    inner, columns = _evaluated_once(signal, condensed, gravity)
    slope = jax.grad(_pulled)(signal, condensed, gravity, inner)
    return inner.value, condensed.sign * slope[condensed.channel, condensed.element], columns


def _evaluated_once(signal, condensed: Condensed, gravity) -> tuple[_Inner, tuple[Array, ...]]:
    """The inner minimum and the columns of A, in memory.

    The inner minimum is a thousand operations for a few numbers. XLA would fuse them into the loops over samples
    that use these numbers, and repeat them for each sample; what a loop returns is stored. That the loop is run
    once must not be known when it is compiled. (On a CPU `optimization_barrier` is gone before anything is fused.)
    """

    once = signal, condensed, gravity
    shapes = jax.eval_shape(_evaluated, *once)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    times = jnp.where(jnp.isnan(gravity), 2, 1)
    return jax.lax.while_loop(
        lambda carry: carry[0] < times, lambda carry: (carry[0] + 1, _evaluated(*once)), (0, blank)
    )[1]


@jax.jit  # so that it is traced once
def _evaluated(signal, condensed: Condensed, gravity):
    motion = _pass(condensed, signal)
    at = _arrive(condensed, motion, gravity)
    inner = _inner(condensed, motion, at)
    return inner, _root(_effect(condensed, motion, at), inner)


def _root(effect: Matrix, inner: _Inner) -> tuple[Float[Array, "m"], ...]:
    """Columns of A: the effect of each value on [θ, v] at arrival times `_Inner.root`."""
    return cast(tuple[Array, ...], (inner.root.T @ effect).entries())


def _effect(condensed: Condensed, motion: Passage, at: _Arrival) -> Matrix:
    """Of each value on [θ, v] at arrival.

    A unit error of a rate turns θ by T e and pushes v by −[V×]T e, V being what its own sample still adds after
    its middle and all that follows it; one of a specific force pushes v by T e. The pull of a height row is
    left out.
    """
    # Of each value: the axis that it turns about or pushes along, and the lever, at arrival.
    attitude = jnp.stack((at.turn @ motion.middle.matrix()).entries())
    lever = jnp.stack(list(at.turn(motion.after[0] + motion.pushed * 0.5)))
    rate = condensed.channel < 3
    axis = jnp.where(rate, condensed.channel, condensed.channel - 3)
    unit = Vector(*(attitude[3 * i + axis, condensed.element] for i in range(3)))
    V = Vector(*lever[:, condensed.element])
    theta = [jnp.where(rate, a, 0.0) for a in unit]
    speed = [jnp.where(rate, a, b) for a, b in zip(unit.cross(V), unit, strict=True)]
    return Matrix.column((*theta, *speed)) * (condensed.sign * condensed.period[condensed.element])


def objective(delta: Float[Array, "m"], condensed: Condensed, gravity: Float[Array, ""]) -> Float[Array, ""]:
    """f(δ) of Eq. 18: the inner minimum J* over departure, moving samples and the rest that follows.

    Differentiable once, in δ and in all that is condensed.
    """
    signal = _compensated(condensed, delta)
    inner, _ = _evaluated_once(*jax.lax.stop_gradient((signal, condensed, gravity)))
    pulled = _pulled(signal, condensed, gravity, inner)
    return inner.value + (pulled - jax.lax.stop_gradient(pulled))
