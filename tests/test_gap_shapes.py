"""Method 2's geometry: the corrected Eq. 21, its guards, and the shapes."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsat.saturation.gap_shapes import Edges, edge_slope, peak, shape_value


def edges(left=5.0, right=5.0, left_slope=0.6, right_slope=-0.4, rail=5.0, sound=True, k=10.0, h=20.0):
    values = (k, h, left, right, left_slope, right_slope, rail)
    return Edges(*(jnp.asarray(v) for v in values), sound=jnp.asarray(sound))


def test_corrected_equation_21_meets_where_the_two_lines_do():
    """k=10, h=20, values 5 and 5, slopes 0.6 and −0.4: the printed formula gives 20 and 17."""
    found = peak(edges(), jnp.asarray(50.0))
    np.testing.assert_allclose([found.time, found.height], [14.0, 7.4])
    assert found.from_slopes


@pytest.mark.parametrize(
    "broken",
    [
        {"left_slope": -0.1},  # falls into the gap
        {"right_slope": 0.3},  # rises out of it
        {"left": 1.0, "right": 9.0, "left_slope": 0.1, "right_slope": -0.1},  # meet outside the gap
        {"rail": 8.0},  # meet below the rail
        {"sound": False},  # fewer than three clean samples beside the gap
    ],
)
def test_guards_fall_back_to_the_middle_and_the_bound(broken):
    found = peak(edges(**broken), jnp.asarray(50.0))
    assert not found.from_slopes
    np.testing.assert_allclose([found.time, found.height], [15.0, 50.0])


def test_height_never_exceeds_the_bound():
    assert peak(edges(), jnp.asarray(6.0)).height == 6.0


@pytest.mark.parametrize("shape", ["triangle", "quadratic"])
def test_shapes_pass_through_both_edges_and_the_peak_and_stay_below_it(shape):
    t = jnp.linspace(10.0, 20.0, 101)
    broad = Edges(
        *(jnp.full(101, x) for x in (10.0, 20.0, 4.0, 4.5, 0.6, -0.4, 5.0)), sound=jnp.ones(101, bool)
    )
    time, height = jnp.asarray(13.0), jnp.asarray(7.0)
    value = shape_value(shape, t, broad, jnp.full(101, time), jnp.full(101, height))
    np.testing.assert_allclose(value[jnp.array([0, 30, 100])], [4.0, 7.0, 4.5], atol=1e-12)
    assert value.max() <= 7.0 + 1e-12


def test_edge_slope_is_exact_for_parabolas():
    def f(t):
        return 2.0 + 3.0 * t - 0.7 * t**2

    t = np.array([4.0, 5.0, 6.0])
    np.testing.assert_allclose(edge_slope(*jnp.asarray(f(t)[:, None])), 3.0 - 1.4 * 4.0)
    np.testing.assert_allclose(-edge_slope(*jnp.asarray(f(t[::-1])[:, None])), 3.0 - 1.4 * 6.0)
