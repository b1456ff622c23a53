"""Settings of decisions in seconds and shares."""

from __future__ import annotations

import math

import pytest

from plushsense.core.errors import ConfigError
from plushsense.runtime.decisions import DecideSpec, argmax_spec
from plushsense.runtime.events import MOST_STEPS
from plushsense.runtime.fixed import LOGIT_LIMIT


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


@pytest.mark.parametrize(
    ("name", "highest"),
    [("smoothing_s", 60), ("rest_s", 60), ("enter", 1), ("leave", 1), ("enter_affect", 2), ("known_margin", 64)],
)
def test_settings_at_the_ends_of_their_range(name, highest):
    for value in (0, highest):
        assert getattr(DecideSpec(**{name: value}), name) == value
    for value in (-0.01, highest + 0.01, True, "1"):
        with pytest.raises(ConfigError, match=f"{name} is .*accepted are"):
            DecideSpec(**{name: value})


def test_settings_become_integers_and_numbers_of_steps():
    seconds = {"least_s": 0.02, "switch_s": 0.3, "end_s": 0.0, "hold_s": 0.02, "rest_s": 0.26, "wait_s": 60.0}
    events = (
        DecideSpec(enter=0.5, leave=0.25, enter_affect=2.0, sure=1.0, known_margin=1.5, **seconds).rules(0.05).events
    )
    assert (events.enter, events.leave, events.enter_affect, events.sure) == (1 << 14, 1 << 13, (1 << 15) + 1, 1 << 15)
    assert (events.least, events.switch, events.end, events.hold, events.rest) == (1, 6, 1, 0, 5)
    assert (events.wait, events.known) == (1200, 384)
    assert DecideSpec(wait_s=60.0).rules(1e-6).events.wait == MOST_STEPS
    assert DecideSpec().rules(0.05).events.known == -LOGIT_LIMIT


def test_settings_that_report_the_best_class_of_every_step():
    spec = argmax_spec()
    events = spec.rules(0.05).events
    assert (spec.smoothing_s, argmax_spec(0.3).smoothing_s) == (0.0, 0.3)
    assert (events.enter, events.leave, events.sure, events.enter_affect) == (0, 0, 1 << 14, (1 << 15) + 1)
    assert (events.least, events.switch, events.end, events.hold, events.rest, events.wait) == (1, 1, 1, 0, 0, 0)
