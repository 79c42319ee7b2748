"""Status values and reasons that libraries and messages share."""

import re
from typing import Literal

TrackingStatus = Literal["ok", "lost", "relocalizing", "rejected"]  # of localization, for one image or scan
_NUMBER = re.compile(r"(?<![A-Za-z_])[-+]?\d[\d.,]*(?:e[-+]?\d+)?", re.IGNORECASE)


def general_reason(text: str) -> str:
    """Return a reason with N in place of all numbers, so that equal reasons can be counted together."""
    return _NUMBER.sub("N", text)
