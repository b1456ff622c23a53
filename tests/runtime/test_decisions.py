"""Settings of decisions in seconds and shares."""

from __future__ import annotations

import math

import pytest

from plushsense.core.errors import ConfigError
from plushsense.runtime.decisions import DecideSpec


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf, 61, True, "0.3", None])
def test_what_is_no_time_constant_is_refused(value):
    with pytest.raises(ConfigError, match="smoothing_s"):
        DecideSpec(smoothing_s=value)


def test_settings_come_back_and_an_unknown_one_names_the_nearest():
    spec = DecideSpec(smoothing_s=0.7)
    assert DecideSpec.from_dict(spec.to_dict()) == spec
    assert DecideSpec.from_dict({}) == DecideSpec()
    assert DecideSpec.from_dict({"known": 5.3}) == DecideSpec(), "of a bundle of an earlier version"
    with pytest.raises(ConfigError, match="smoothing_s"):
        DecideSpec.from_dict({"smoothing": 0.7})
