"""Many samples as few stretches, with the noise they carry: motion that no state and no row interrupts.

An error of one sample reaches the end of a motion through its levers: V and, where heights matter, W of what
follows it, in the body frame at the start. A rate that is off by ε turns θ by b = [I; −[V×]; −[W×]] Tε, a specific
force moves v and r by T and T(½T + τ). Noise that is the same on all axes of a sensor therefore needs no more
than sums of levers and of their products.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsat.inertial.components import Matrix, Quaternion, Scalar, Vector

_STILL = Quaternion(1.0, 0.0, 0.0, 0.0)

Levers = tuple[Vector, ...]
"""(V,) or (V, W): first and second integral of the specific force, seen from the start (m/s, m)."""


class SensorNoise(eqx.Module):
    """Sums over the samples of a stretch, with c = variance · T² of the gyroscope and a that of the accelerometer."""

    weight: Scalar
    """Σ c."""
    first: tuple[Vector, ...]
    """Σ c h of each lever h."""
    second: tuple[tuple[Matrix, ...], ...]
    """Σ c h h'ᵀ of each pair of levers."""
    force: tuple[tuple[Scalar, ...], ...]
    """Σ a s s' with s = 1 for the velocity and ½T + τ for the position."""

    def __add__(self, other: "SensorNoise") -> "SensorNoise":
        return jax.tree.map(jnp.add, self, other)

    def sum(self) -> "SensorNoise":
        """Of all stretches (leading axis)."""
        return jax.tree.map(lambda x: jnp.sum(x, axis=0), self)

    def covariance(self) -> Matrix:
        """Of [θ, v] or [θ, v, r] at the end, in the frame of the start; [x×][y×]ᵀ = (x·y)I − y xᵀ."""
        lifts = [-Matrix.skew(h) for h in self.first]
        rows = [[Matrix.identity(3, self.weight), *(lift.T for lift in lifts)]]
        for i, lift in enumerate(lifts):
            blocks = [
                Matrix.identity(3, self.second[i][j].trace() + self.force[i][j]) - self.second[j][i]
                for j in range(len(lifts))
            ]
            rows.append([lift, *blocks])
        return Matrix.block(rows)

    def along(self, turn: Vector, pull: Levers) -> Scalar:
        """Σ over the gyroscope's errors of c |t + Σ_h h × p_h|², and of the accelerometer's of a |Σ s_h p_h|².

        With t and p the multipliers of θ and of each lever this is λᵀ·covariance·λ, for less.
        """
        turned = _total(h.cross(p) for h, p in zip(self.first, pull, strict=True))
        value = self.weight * turn.dot(turn) + 2.0 * turn.dot(turned)
        for i, p in enumerate(pull):
            for j, q in enumerate(pull):
                block = self.second[i][j]
                value = value + (block.trace() + self.force[i][j]) * p.dot(q) - q.dot(block(p))
        return value


def _total(vectors) -> Vector:
    first, *others = vectors
    for other in others:
        first = first + other
    return first


def sample_noise(levers: Levers, duration: Scalar, period: Scalar, variance: tuple[Scalar, Scalar]):
    """Noise of a single sample; levers, duration: of what follows it."""
    c, a = (v * period**2 for v in variance)
    s = (jnp.ones_like(period), 0.5 * period + duration)[: len(levers)]
    return SensorNoise(
        weight=c,
        first=tuple(h * c for h in levers),
        second=_symmetric([[(h * c).outer(k) for k in levers] for h in levers]),
        force=tuple(tuple(a * x * y for y in s) for x in s),
    )


def followed(noise: SensorNoise, attitude: Quaternion | None, later: Levers, duration: Scalar) -> SensorNoise:
    """The noise of a stretch that starts at an attitude and has `later` behind it, in the frame of that attitude.

    attitude: None for none.
    """
    first, second, force = list(noise.first), [list(row) for row in noise.second], noise.force
    if len(later) == 2:
        # Time carries each velocity lever on into the position lever.
        first[1] = first[1] + first[0] * duration
        second[0][1] = second[0][1] + second[0][0] * duration
        second[1][0] = second[1][0] + second[0][0] * duration
        second[1][1] = second[1][1] + noise.second[1][0] * duration + second[0][1] * duration
        cross = force[0][1] + force[0][0] * duration
        square = force[1][1] + (force[0][1] + cross) * duration
        force = ((force[0][0], cross), (cross, square))
    if attitude is not None:
        R = attitude.matrix()
        first = [R(h) for h in first]
        second = [[R @ block @ R.T for block in row] for row in second]
    n = noise.weight
    for i, row in enumerate(second):
        for j, block in enumerate(row):
            row[j] = block + first[i].outer(later[j]) + later[i].outer(first[j] + later[j] * n)
    return SensorNoise(
        weight=n,
        first=tuple(h + add * n for h, add in zip(first, later, strict=True)),
        second=_symmetric(second),
        force=force,
    )


def _symmetric(second: list[list[Matrix]]) -> tuple[tuple[Matrix, ...], ...]:
    """Sums of h h'ᵀ from those on and above the diagonal."""
    if len(second) == 1:
        return ((second[0][0].mirrored(),),)
    cross = second[0][1]
    return (second[0][0].mirrored(), cross), (cross.T, second[1][1].mirrored())


class Stretch(eqx.Module):
    """Samples between two that are looked at one by one."""

    rotation: Quaternion
    levers: Levers
    duration: Scalar
    noise: SensorNoise

    @staticmethod
    def empty(position: bool, like: Scalar) -> "Stretch":
        """No sample; position: carry W too."""
        zero, one = jnp.zeros_like(like), jnp.ones_like(like)
        still = Vector(zero, zero, zero)
        levers = (still, still) if position else (still,)
        return Stretch(
            Quaternion(one, zero, zero, zero), levers, zero, sample_noise(levers, zero, zero, (zero, zero))
        )

    def then(self, gyr: Vector, acc: Vector, period: Scalar, variance: tuple[Scalar, Scalar]) -> "Stretch":
        """With one more sample behind it."""
        half = Quaternion.exp(gyr * (0.5 * period))
        pushed = (self.rotation @ half).rotate(acc) * period
        later = (pushed, pushed * (0.5 * period))[: len(self.levers)]
        nothing = Stretch.empty(len(later) == 2, period)
        moved = (
            self.levers[0] + pushed,
            *(W + self.levers[0] * period + later[1] for W in self.levers[1:]),
        )
        return Stretch(
            rotation=self.rotation @ (half @ half),
            levers=moved,
            duration=self.duration + period,
            noise=followed(self.noise, None, later, period)
            + sample_noise(nothing.levers, nothing.duration, period, variance),
        )


def stretches(
    signal: Float[Array, "N 6"],
    period: Float[Array, "N"],
    variance: Float[Array, "N 2"],
    cut: Bool[Array, "N"],
    position: bool,
) -> tuple[Stretch, Stretch]:
    """What lies between the cut samples, which belong to no stretch.

    Returns, for every sample, the stretch since the last cut sample (read it at the cut ones), and the one
    that is open at the end. Composed sample by sample: no difference of large prefixes is taken.
    """
    empty = Stretch.empty(position, period[0])

    def step(open_, inputs):
        gyr, acc, T, v, is_cut = inputs
        longer = open_.then(gyr, acc, T, v)
        return jax.tree.map(lambda e, x: jnp.where(is_cut, e, x), empty, longer), open_

    inputs = (
        Vector.of(signal[:, :3]),
        Vector.of(signal[:, 3:]),
        period,
        (variance[:, 0], variance[:, 1]),
        cut,
    )
    last, before = jax.lax.scan(step, empty, inputs)
    return before, last


@jax.custom_jvp
def attitude_prefixes(rotations: Quaternion) -> Quaternion:
    """q₀⊗…⊗q_j for each j of the leading axis.

    The derivative is that of rotations and holds for unit quaternions only: what a tangent would change of their
    length is left out.
    """

    def step(total, rotation):
        total = total @ rotation
        return total, total

    still = jax.tree.map(lambda a, value: jnp.full_like(a[0], value), rotations, _STILL)
    return jax.lax.scan(step, still, rotations)[1]


@attitude_prefixes.defjvp
def _attitude_prefixes_jvp(primals, tangents):
    # A right turn φ_i of factor i is a left turn R_i φ_i of every product from i on, so tangents add up.
    (rotations,), (rates,) = primals, tangents
    totals = attitude_prefixes(rotations)
    turned = totals.rotate((rotations.conjugate() @ rates).vector)
    x, y, z = (jnp.cumsum(a, axis=0) for a in turned)
    return totals, Quaternion(jnp.zeros_like(x), x, y, z) @ totals


class Passage(eqx.Module):
    """M stretches, each followed by a sample: the whole as seen from its start, and from each sample."""

    rotation: Quaternion
    """At the end."""
    levers: Levers
    duration: Scalar
    start: Quaternion
    """Attitude at the start of each stretch."""
    middle: Quaternion
    """Attitude in the middle of each sample."""
    pushed: Vector
    """What each sample adds to V."""
    later: Levers
    """Levers of what follows each stretch."""
    after: Levers
    """Levers of what follows each sample."""
    left: Scalar
    """Time that follows each sample (s)."""
    period: Scalar
    variance: tuple[Scalar, Scalar]
    stretch_noise: SensorNoise

    def noise_covariance(self) -> Matrix:
        """Of [θ, v] or [θ, v, r] at the end, in the frame of the start."""
        stretches = followed(self.stretch_noise, self.start, self.later, self.left + self.period)
        samples = sample_noise(self.after, self.left, self.period, self.variance)
        return (stretches + samples).sum().covariance()

    def noise_along(self, turn: Vector, pull: Levers) -> Scalar:
        """λᵀ·`noise_covariance`·λ with λ = [turn, pull…]: each error is met in its own frame, none is turned."""
        here = _total((turn, *(h.cross(p) for h, p in zip(self.later, pull, strict=True))))
        back = self.start.conjugate()
        mine = list(pull)
        if len(pull) == 2:
            mine[0] = pull[0] + pull[1] * (self.left + self.period)
        stretches = self.stretch_noise.along(back.rotate(here), tuple(back.rotate(p) for p in mine))
        c, a = (v * self.period**2 for v in self.variance)
        behind = _total((turn, *(h.cross(p) for h, p in zip(self.after, pull, strict=True))))
        force = pull[0]
        if len(pull) == 2:
            force = force + pull[1] * (0.5 * self.period + self.left)
        return jnp.sum(stretches + c * behind.dot(behind) + a * force.dot(force))


def passage(
    stretch: Stretch, gyr: Vector, acc: Vector, period: Float[Array, "M"], variance: tuple[Array, Array]
) -> Passage:
    """Join stretches (leading axis M) and the samples behind each of them; everything by running sums."""
    half = Quaternion.exp(gyr * (0.5 * period))
    upto = attitude_prefixes(stretch.rotation @ (half @ half))
    start = jax.tree.map(_before, upto, _STILL)
    middle = start @ stretch.rotation @ half
    pushed = middle.rotate(acc) * period
    carried = start.rotate(stretch.levers[0])
    step = carried + pushed
    velocity = _each(lambda a: jnp.cumsum(a, axis=0), step)
    total = _each(lambda a: a[-1], velocity)
    elapsed = jnp.cumsum(stretch.duration + period)
    left = elapsed[-1] - elapsed
    levers, after = (total,), (total - velocity,)
    later = (after[0] + pushed,)
    if len(stretch.levers) == 2:
        moved = start.rotate(stretch.levers[1]) + carried * period + pushed * (0.5 * period)
        reached = _each(
            lambda a: jnp.cumsum(a, axis=0),
            moved + _each(lambda a: _before(a, 0.0), velocity) * (stretch.duration + period),
        )
        end = _each(lambda a: a[-1], reached)
        levers, after = (total, end), (after[0], end - reached - velocity * left)
        later = (later[0], after[1] + pushed * (left + 0.5 * period))
    return Passage(
        rotation=jax.tree.map(lambda a: a[-1], upto),
        levers=levers,
        duration=elapsed[-1],
        start=start,
        middle=middle,
        pushed=pushed,
        later=later,
        after=after,
        left=left,
        period=period,
        variance=variance,
        stretch_noise=stretch.noise,
    )


def _before(a: Array, first: float) -> Array:
    """One step later, beginning with `first`."""
    return jnp.concatenate([jnp.full_like(a[:1], first), a[:-1]])


def _each(function, vector: Vector) -> Vector:
    return Vector(*(function(a) for a in vector))
