"""Reactions: who is answered, when, and what is never answered with a show."""

from __future__ import annotations

import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import load_gestures
from plushsense.live.reactions import Reaction, Reactions, Reactor, load_reactions, reaction_names
from plushsense.runtime.classifier import Decision, GestureEvent


def event(number, affect, t_s, what="begun", gesture=None, since_s=None):
    return GestureEvent(what, number, affect, gesture, "cnn", t_s - 0.1 if since_s is None else since_s, t_s)


def own(*lines):
    return Reactions.from_dict({"name": "own", "reactions": list(lines)})


GREEN = {"affect": "positive", "eyes": "green", "sound": "purr", "seconds": 2.0}


def shown(profile, *events):
    return [(r.t_s, r.eyes, r.sound) for r in Reactor(profile).push(events)]


def test_the_built_in_profiles_load_and_come_back_from_plain_values():
    assert set(reaction_names()) == {"standard", "gentle"}
    for name in reaction_names():
        profile = load_reactions(name, load_gestures("plush-18"))
        assert profile.name == name
        assert Reactions.from_dict(profile.to_dict()) == profile


def test_kindness_is_answered_and_roughness_as_the_profile_says():
    events = (event(1, "positive", 1.0), event(2, "negative", 2.0), event(3, "neutral", 3.0))
    assert shown(load_reactions("standard"), *events) == [(1.0, "green", "purr"), (2.0, "red", "shriek")]
    assert shown(load_reactions("gentle"), *events) == [(1.0, "green", "purr"), (2.0, "off", "")]


def test_gentle_never_answers_roughness_with_a_show():
    profile = load_reactions("gentle")
    assert not any(line.shows for line in profile.lines if line.affect == "negative")
    for gesture in load_gestures("plush-18").gestures:
        line = profile.answer(gesture.affect, gesture.label)
        assert gesture.affect != "negative" or (line is not None and not line.shows)
    # What comes right after it, a stroke or a misread blow, is no show either.
    reactor = Reactor(profile)
    assert [r.eyes for r in reactor.push([event(1, "negative", 1.0)])] == ["off"]
    assert reactor.push([event(2, "positive", 1.5), event(3, "negative", 2.0)])[0].affect == "negative"
    assert reactor.push([event(4, "positive", 4.9)]) == []
    assert [r.eyes for r in reactor.push([event(5, "positive", 5.0)])] == ["green"]


def test_an_event_is_answered_once_and_none_within_the_refractory_time_of_its_affect():
    profile = own(
        {**GREEN, "refractory_s": 3.0}, {"affect": "negative", "eyes": "red", "seconds": 1.0, "refractory_s": 1.0}
    )
    assert shown(profile, event(1, "positive", 1.0), event(1, "positive", 1.4, "named", "Back stroke 1")) == [
        (1.0, "green", "purr")
    ]
    found = shown(
        profile,
        event(1, "positive", 1.0),
        event(2, "positive", 3.9),
        event(3, "negative", 3.95),
        event(2, "positive", 4.5, "named", "Tail tap 1"),
        event(4, "positive", 4.6),
    )
    assert found == [(1.0, "green", "purr"), (3.95, "red", ""), (4.6, "green", "purr")]


def test_a_gesture_overrides_its_affect_and_waits_for_its_moment():
    hug = {"gesture": "hold_strong", "eyes": "green", "sound": "hum", "seconds": 4.0}
    assert shown(own(GREEN, hug), event(1, "positive", 1.0, gesture="Hold strong")) == [(1.0, "green", "hum")]
    assert shown(own(GREEN, hug), event(1, "positive", 1.0, gesture="Tail tap 1")) == [(1.0, "green", "purr")]
    # While the gesture is not known its affect is answered; who wants the gesture's answer lets the affect wait.
    told = (event(1, "positive", 1.0), event(1, "positive", 1.5, "named", "Hold strong"))
    assert shown(own(GREEN, hug), *told) == [(1.0, "green", "purr")]
    assert shown(own({**GREEN, "when": "named"}, hug), *told) == [(1.5, "green", "hum")]
    assert shown(own(hug), *told) == [(1.5, "green", "hum")]
    ended = own({**hug, "when": "ended"})
    assert shown(ended, *told, event(1, "positive", 6.0, "ended", "Hold strong")) == [(6.0, "green", "hum")]


@pytest.mark.parametrize(
    ("state", "since_s", "answers"),
    [("tracking", 2.0, 1), ("warming", 1.7, 1), ("warming", 2.0, 0), ("no signal", 2.0, 0), ("sensor fault", 2.0, 0)],
)
def test_an_end_that_only_the_signal_made_is_not_answered(state, since_s, answers):
    said = event(1, "positive", 2.0, "ended", since_s=since_s)
    decision = Decision(2.0, None, None, None, "cnn", state, None, None, (said,))
    assert len(Reactor(own({**GREEN, "when": "ended"})).push(decision)) == answers


def test_a_new_stream_begins_anew():
    reactor = Reactor(load_reactions("standard"))
    assert len(reactor.push([event(1, "positive", 1.0)])) == 1
    assert reactor.push([event(1, "positive", 0.5)]) == []
    reactor.reset()
    assert reactor.push([event(1, "positive", 0.5)]) == [Reaction(0.5, "green", "purr", 2.5, 1, "positive", None)]


BAD = [
    ('reactions = [{ afect = "positive" }]', "Did you mean 'affect'?"),
    ("reacts = []", "Did you mean 'reactions'?"),
    ('reactions = [{ affect = "positiv", eyes = "green", seconds = 1 }]', "Did you mean 'positive'?"),
    ('reactions = [{ affect = "positive", eyes = "gren", seconds = 1 }]', "Did you mean 'green'?"),
    ('reactions = [{ affect = "positive", when = "named " }]', "Did you mean 'named'?"),
    ('reactions = [{ gesture = "Hold stron" }]', "Did you mean 'Hold strong'?"),
    ('reactions = [{ affect = "positive", gesture = "Hold strong" }]', "both"),
    ('reactions = [{ eyes = "off" }]', "neither"),
    ('reactions = [{ affect = "positive", eyes = "green" }]', "seconds above 0"),
    ('reactions = [{ affect = "positive", seconds = -1 }]', "0 to 60 seconds"),
    ('reactions = [{ affect = "positive", refractory_s = true }]', "accepted is a number"),
    ('reactions = [{ affect = "positive", refractory_s = nan }]', "accepted is a number"),
    ('reactions = [{ affect = "positive", sound = "../x" }]', "letters, digits"),
    ('reactions = [{ affect = "positive", eyes = 3 }]', "eyes is 3: accepted is text"),
    ('reactions = [{ affect = "negative" }, { affect = "negative" }]', "twice"),
    ('reactions = "green"', "list of tables"),
    ("name = 3\nreactions = []", "name is 3: accepted is text"),
    ("reactions = [", "not valid TOML"),
]


@pytest.mark.parametrize(("text", "said"), BAD)
def test_a_file_that_does_not_fit_is_refused_in_one_sentence(tmp_path, text, said):
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as refusal:
        load_reactions(path, load_gestures("plush-18"))
    assert said in str(refusal.value)
    assert "own.toml" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_an_unknown_name_says_which_there_are():
    with pytest.raises(ConfigError, match=r"gentle, standard; .* Did you mean 'gentle'\?"):
        load_reactions("gentel")
    with pytest.raises(ConfigError, match="There is no reactions file"):
        load_reactions("nowhere.toml")
