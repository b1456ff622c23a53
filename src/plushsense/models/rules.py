"""All that stands between the frames, the network's logits and what a toy says: events, gate, health."""

from __future__ import annotations

from dataclasses import dataclass, field

from plushsense.models.events import EventPlan
from plushsense.models.gate import GatePlan
from plushsense.models.health import HealthPlan


@dataclass(frozen=True)
class Rules:
    """The settings of a deployed toy beside its network; the defaults say the best class of every step."""

    events: EventPlan = field(default_factory=EventPlan)
    gate: GatePlan = field(default_factory=GatePlan)
    health: HealthPlan = field(default_factory=lambda: HealthPlan(fault_ms=0))
