"""Planted faults in what the C makes of events, gate and health, for `plushsense.deploy.faults`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["weight", "shift", "index", "rounding", "clamp", "rule", "constant", "event", "gate", "health"]
RULES: tuple[Kind, ...] = ("event", "gate", "health")  # what drills are for


@dataclass(frozen=True)
class Text:
    """A fault in the C; ``when`` says which models can show it."""

    kind: Kind
    name: str
    text: str
    wrong: str
    when: Literal["always", "dilated", "magnitude", "ranged", "smoothed", "stepped", "ties"] = "always"


RULE_TEXTS = (
    Text(
        "event",
        "known is not asked for",
        "if (toy->answer.known < known_least(toy->event_plan))",
        "if (toy->answer.known < -LOGIT_LIMIT)",
    ),
    Text(
        "event", "known is not smoothed", "*known = smoothed(toy, *known, highest * 4096);", "*known = highest * 4096;"
    ),
    Text(
        "event",
        "an idle class answers as any other",
        "    if (is_idle(toy, best))\n        return PLUSH_IDLE;",
        "    if (is_idle(toy, best) && sure == 0)\n        return PLUSH_IDLE;",
    ),
    Text(
        "event",
        "a class just as sure as asked for is left out",
        "if (share_of(toy, k) >= sure) {",
        "if (share_of(toy, k) > sure + 200) {",
    ),
    Text(
        "event",
        "idle classes count for an affect",
        "if (toy->classes_told[k] == affect)",
        "if (affect_of(toy, k) == affect)",
    ),
    Text(
        "event",
        "an affect alone never begins an event",
        "return most >= setting(toy, ENTER_AFFECT) ?",
        "return most > PLUSH_ONE ?",
    ),
    Text(
        "event",
        "a gesture begins at the share at which it may stay",
        "else if (toy->answer.confidence >= setting(toy, ENTER)) {",
        "else if (toy->answer.confidence >= setting(toy, LEAVE)) {",
    ),
    Text(
        "event",
        "an event begins a step too soon",
        "toy->wanted_for >= setting(toy, LEAST))\n        begin_event",
        "toy->wanted_for + 1u >= setting(toy, LEAST))\n        begin_event",
    ),
    Text(
        "event",
        "an event begins without resting after the last",
        "    toy->resting = (uint16_t)setting(toy, REST);\n    tell",
        "    toy->resting = 0;\n    tell",
    ),
    Text(
        "event",
        "a name is given at once",
        "return toy->named_for >= setting(toy, LEAST) ?",
        "return toy->named_for >= 1u ?",
    ),
    Text(
        "event",
        "a gesture stays at the share at which it begins",
        "share_of(toy, event->gesture) >= setting(toy, LEAVE)",
        "share_of(toy, event->gesture) >= setting(toy, ENTER)",
    ),
    Text(
        "event",
        "an affect stays at the share at which it begins",
        "mass_of(toy, event->affect) >= setting(toy, LEAVE_AFFECT)",
        "mass_of(toy, event->affect) >= setting(toy, ENTER_AFFECT)",
    ),
    Text(
        "event",
        "an idle class ends nothing",
        "if (is_idle(toy, best) && share_of(toy, best) >= setting(toy, ENTER))",
        "if (is_idle(toy, best) && share_of(toy, best) > PLUSH_ONE)",
    ),
    Text(
        "event",
        "an event ends a step too late",
        "if (toy->away >= setting(toy, END) &&",
        "if (toy->away > setting(toy, END) &&",
    ),
    Text(
        "event",
        "an event ends without being held",
        "toy->lasted >= setting(toy, HOLD))\n        end_event",
        "toy->lasted > 0)\n        end_event",
    ),
    Text(
        "event",
        "another event comes without the last being held",
        ">= setting(toy, SWITCH) &&\n           toy->lasted >= setting(toy, HOLD);",
        ">= setting(toy, SWITCH);",
    ),
    Text(
        "event",
        "another event comes a step too soon",
        ": toy->wanted_for) >= setting(toy, SWITCH)",
        ": toy->wanted_for) + 1 >= setting(toy, SWITCH)",
    ),
    Text(
        "event",
        "another gesture of its affect counts as long as the affect",
        "(said != PLUSH_NO_GESTURE && its_affect ? toy->named_for : toy->wanted_for)",
        "(toy->wanted_for)",
    ),
    Text(
        "event",
        "misses are counted on after the event was seen again",
        "    } else if (stays(toy, best)) {\n        toy->away = 0;",
        "    } else if (stays(toy, best)) {\n        toy->away += 0;",
    ),
    Text(
        "event",
        "an event of the gate waits a step less for its name",
        "    toy->wait = (uint16_t)setting(toy, WAIT);",
        "    toy->wait = (uint16_t)(setting(toy, WAIT) - 1u);",
    ),
    Text(
        "event",
        "while warming nothing ends",
        "    if (toy->wait > 0)\n        toy->wait--;\n    else\n        miss(toy, ms);",
        "    if (toy->wait > 0)\n        toy->wait--;",
    ),
    Text(
        "event",
        "what was wanted survives silence",
        "    toy->wanted = toy->wanted_for = toy->named_for = 0;\n",
        "    toy->resting = 0;\n",
    ),
    Text(
        "event",
        "the smoothing survives silence",
        "    toy->started = 0;\n    toy->resting = 0;",
        "    toy->resting = 0;",
    ),
    Text(
        "event",
        "a suspect step counts",
        "    if (!toy->suspect) {\n        if (toy->answer.kind",
        "    if (toy->classes) {\n        if (toy->answer.kind",
    ),
    Text("event", "a suspect step ends events", "} else if (locked || toy->suspect) {", "} else if (locked) {"),
    Text("gate", "the gate is never deaf", "toy->gate_deaf = (uint16_t)le16(rule + 4);", "toy->gate_deaf = 0;"),
    Text(
        "gate",
        "a blow must come in one sample less",
        "        if (*row == term[2])",
        "        if (*row + 1 >= term[2])",
    ),
    Text("gate", "terms hold a sample longer", "*left = (uint16_t)(longer + 1);", "*left = (uint16_t)(longer + 2);"),
    Text(
        "gate",
        "the sign of a deviation is not asked for",
        "if ((term[1] != SIGN_BELOW && size >= threshold) ||",
        "if (size >= threshold ||",
    ),
    Text(
        "gate",
        "a size just as great as asked for is too small",
        "(term[1] != SIGN_ABOVE && -size >= threshold)",
        "(term[1] != SIGN_ABOVE && -size > threshold)",
    ),
    Text("gate", "the last rule that fires speaks", "if (every && fired == NULL)", "if (every)"),
    Text(
        "gate",
        "jerk is the change from one sample before",
        "*before = past_inputs(toy, lag);",
        "*before = past_inputs(toy, 1);",
    ),
    Text(
        "gate",
        "the baseline follows at the pace of the noise",
        "shift_down(value * 256 - state[BASELINE], how[2])",
        "shift_down(value * 256 - state[BASELINE], how[3])",
    ),
    Text(
        "gate",
        "one blow deafens the noise",
        "    if (size > 4 * level)\n        size = 4 * level;\n",
        "    if (size > 8 * level)\n        size = 8 * level;\n",
    ),
    Text(
        "gate",
        "the noise has no floor of its own",
        "level = (state[NOISE] >> 8) + (int32_t)le32(how + 4);",
        "level = (state[NOISE] >> 8) + 1;",
    ),
    Text(
        "gate",
        "the baseline begins at 0",
        "    if (toy->gate_seen == 0)\n        state[BASELINE]",
        "    if (toy->gate_seen > 200)\n        state[BASELINE]",
    ),
    Text(
        "gate",
        "samples that repeat the one before are read",
        "if (toy->gate_seen > 0 && same(past_inputs(toy, 0)",
        "if (toy->gate_seen > 200 && same(past_inputs(toy, 0)",
    ),
    Text(
        "gate",
        "suspect samples are read",
        "    if (toy->suspect) {\n        if (toy->gate_doubt",
        "    if (toy->suspect && deaf > 1) {\n        if (toy->gate_doubt",
    ),
    Text(
        "gate",
        "a suspect sample makes the gate begin anew at once",
        "++toy->gate_doubt == GATE_DOUBT) {",
        "++toy->gate_doubt == 1u) {",
    ),
    Text(
        "gate",
        "the gate never begins anew",
        "toy->gate_doubt < GATE_DOUBT && ++toy",
        "toy->gate_doubt > GATE_DOUBT && ++toy",
    ),
    Text(
        "gate",
        "the gate begins an event in one of its own affect",
        "if (going_on(toy) && (toy->event.affect == rule[1] ||",
        "if (going_on(toy) && (",
    ),
    Text(
        "gate",
        "the gate takes the place of its own event",
        "(toy->event.affect == rule[1] || toy->event.source == PLUSH_GATE))",
        "(toy->event.affect == rule[1]))",
    ),
    Text(
        "health",
        "a value stuck beyond the limits is believed",
        "return toy->limits != NULL && toy->compared &&",
        "return toy->limits == toy->ranges && toy->compared &&",
    ),
    Text(
        "health",
        "a value beyond the limits need not be stuck",
        "toy->compared && value == toy->last[channel] &&",
        "toy->compared && value != INT32_MAX &&",
    ),
    Text("health", "a fault needs no time", "ms - toy->wrong_ms >= fault_ms)", "ms >= toy->wrong_ms)"),
    Text(
        "health",
        "the time of a fault goes on after a good frame",
        "if (wrong && !toy->wrong)",
        "if (wrong && !toy->wrong && toy->wrong_ms == 0)",
    ),
    Text("health", "a frozen toy is no fault", "(still && quiet >= frozen_ms));", "(still && quiet > 60000u));"),
    Text(
        "health",
        "a frozen toy is suspect at once",
        "(wrong || (still && quiet >= (frozen_ms + 1) / 2));",
        "(wrong || still);",
    ),
    Text(
        "health",
        "a fault recovers with the first good frame",
        "if (ms - toy->good_ms < le16(toy->health_plan + RECOVER_MS))",
        "if (ms < toy->good_ms)",
    ),
    Text(
        "health",
        "bad frames do not break the recovery",
        "    if (toy->suspect) {\n        toy->good = 0;",
        "    if (toy->suspect) {",
    ),
    Text(
        "health",
        "what was frozen before a gap is frozen after it",
        "toy->suspect = toy->compared = toy->wrong = toy->good = 0;",
        "toy->suspect = toy->good = 0;",
    ),
    Text(
        "health",
        "an event goes on through a fault",
        "        if (toy->faulty)\n            lose(toy, ms);\n        forget(toy);",
        "        forget(toy);",
    ),
    Text(
        "health",
        "frames are read in a fault",
        "    if (toy->faulty)\n        return 0;\n    toy->heard",
        "    toy->heard",
    ),
)
