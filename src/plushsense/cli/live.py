"""Implement ``plushsense live --device URL --model BUNDLE``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from plushsense.cli.output import say, warn, write_line
from plushsense.cli.signals import interrupt_on_signals

if TYPE_CHECKING:
    from plushsense.live.reactions import Reaction
    from plushsense.models.bundle import Bundle
    from plushsense.runtime.classifier import Decision, GestureEvent, State, StreamReader

STATES = {
    "warming": "collecting the first samples",
    "tracking": "reading",
    "no signal": "no signal",
    "unreadable": "unreadable",
    "sensor fault": "sensor fault: the readings are not plausible",
}


def run(args: argparse.Namespace) -> int:
    from plushsense.devices.opening import open_device
    from plushsense.live.loop import run_live
    from plushsense.live.reactions import Reactor, load_reactions
    from plushsense.models.bundle import Bundle
    from plushsense.runtime.classifier import BothEngines

    bundle = Bundle.load(args.model)
    classifier = _classifier(args, bundle)
    reactor = Reactor(load_reactions(args.reactions, bundle.gestures)) if args.reactions else None
    with interrupt_on_signals(), open_device(args.device, bundle.layout, reconnect=args.reconnect) as device:
        say(
            f"reading {args.device}; {bundle.arch.symbol}, a decision every "
            f"{classifier.step_s * 1000:.0f} ms; Ctrl-C ends"
        )
        if bundle.simulated:
            say("SIMULATION: this network was trained on virtual people, so what it says of a real toy is no result")
        for assumed in device.notes:
            say(f"warning: {args.device}: {assumed}")
        fresh: list[str] = []

        def note(sentence: str) -> None:
            if args.text:
                write_line(f"{classifier.time_s:9.2f} s  warning: {sentence}")
            else:
                warn(sentence)
                fresh.append(sentence)

        live = run_live(device, classifier, seconds=args.seconds, warn=note)
        try:
            state: State | None = None
            for decision in live:
                reactions = reactor.push(decision) if reactor else []
                if args.text or args.events:
                    changed, state = decision.state != state, decision.state
                    if not (changed or decision.events or reactions or fresh):
                        continue
                if args.text:
                    lines = format_update(decision, changed, reactions)
                else:
                    more: dict[str, object] = {"reactions": [r.to_dict() for r in reactions]} if reactor else {}
                    if decision.state == "unreadable":
                        more["mismatch"] = device.mismatch
                    if fresh:
                        more["warnings"] = fresh.copy()
                        fresh.clear()
                    lines = [json.dumps(decision.to_dict() | more, ensure_ascii=False)]
                if lines:
                    write_line("\n".join(lines))
        except KeyboardInterrupt:
            pass
        finally:
            both = {"agreement": vars(classifier.agreement())} if isinstance(classifier, BothEngines) else {}
            say(json.dumps(live.summary().to_dict() | both))
    return 0


def _classifier(args: argparse.Namespace, bundle: Bundle) -> StreamReader:
    """Create the classifier of the chosen engine, with the options that change its decisions."""
    from plushsense.deploy.quantize import classifier_of
    from plushsense.runtime.decisions import DecideSpec

    decide = DecideSpec.from_dict(bundle.decision)
    if args.smoothing is not None:
        decide = replace(decide, smoothing_s=args.smoothing)
    classifier = classifier_of(bundle, decide, args.engine)
    classifier.sensitivity = args.sensitivity
    return classifier


def format_update(decision: Decision, state_changed: bool, reactions: Sequence[Reaction] = ()) -> list[str]:
    """Format event changes, reactions and, if ``state_changed``, the new state as lines of text."""
    lines = [f"{event.t_s:9.2f} s  {_event(event)}" for event in decision.events]
    lines += [f"{reaction.t_s:9.2f} s    {_reaction(reaction)}" for reaction in reactions]
    if state_changed:
        lines.append(f"{decision.t_s:9.2f} s  {STATES[decision.state]}")
    return lines


def _event(event: GestureEvent) -> str:
    affect = "" if event.affect == "none" else event.affect
    name = ": ".join(part for part in (affect, event.gesture) if part) or "something"
    if event.kind == "ended":
        return f"  end of {event.number}, {name}"
    by = " (gate)" if event.source == "gate" and event.kind == "begun" else ""
    return f"{event.number} {name}{by}" if event.kind == "begun" else f"{event.number} it is {name}"


def _reaction(reaction: Reaction) -> str:
    parts = [f"eyes {reaction.eyes}", *([reaction.sound] if reaction.sound else [])]
    duration = f" for {reaction.seconds:g} s" if reaction.seconds else ""
    return f"the toy: {', '.join(parts)}{duration}"
