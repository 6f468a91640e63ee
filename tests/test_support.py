"""What a recording can be used for."""

import equinox as eqx
import jax
import numpy as np
import pytest
from shaking import recording, shaken

from jaxsat.errors import InputError
from jaxsat.periodic import estimate_periodic
from jaxsat.signals.support import find_band, find_support


def test_the_band_is_found_or_its_absence_is_said_with_what_remains(key):
    _, _, acc, _ = shaken(seconds=10.0)
    band = find_band(acc, 0.01)
    assert band is not None
    low, peak, high = band
    assert low < 6 < high and peak == pytest.approx(6, abs=0.3)
    noise = np.asarray(jax.random.normal(key, (3000, 6)))
    assert find_band(noise[:, :3], 0.01) is None
    nothing = recording(noise[:, :3] + [0, 0, 9.81], noise[:, 3:], seconds=30.0)
    support = find_support(nothing)
    assert (support.trajectory, support.periodic, support.orientation) == (False, False, True)
    with pytest.raises(InputError, match=r"no frequency stands out.*supports orientation.*no trajectory"):
        estimate_periodic(nothing)
    still = eqx.tree_at(lambda r: r.gyr, nothing, 1e-3 * nothing.gyr)
    still = eqx.tree_at(lambda r: r.acc, still, 1e-2 * noise[:, :3] + [0, 0, 9.81])
    assert find_support(still).trajectory


def test_real_tremor_has_its_known_frequencies(shared_data):
    """The data's own description: 5.9 Hz at rest, 7.4 to 7.8 Hz in posture."""
    from jaxsat.signals.readers import read

    for pattern, low, high in (("*POSTURAL*LEFT*", 7.2, 8.0),):
        (path,) = (shared_data / "tremor").glob(pattern)
        found = find_band(read(path).acc, 0.01)
        assert found is not None and low < found[1] < high


def test_the_arm_that_moves_from_rest_to_rest_has_a_trajectory_but_no_period(shared_data):
    from jaxsat.signals.readers import read

    support = find_support(read(shared_data / "robot_arm" / "V1500_Sequencia4_SENTRAL.mat"))
    assert support.trajectory and not support.periodic
