"""What may be wrong with recordings: each check is one function and one line in `table.CHECKS`."""

from plushsense.dataset.quality.examined import NEVER_STOPPED_FACTOR, Examined, measured_rate_hz, usual_rows
from plushsense.dataset.quality.table import CHECKS, findings

__all__ = ["CHECKS", "NEVER_STOPPED_FACTOR", "Examined", "findings", "measured_rate_hz", "usual_rows"]
