"""Status values that libraries and messages share."""

from typing import Literal

TrackingStatus = Literal["ok", "lost", "relocalizing", "rejected"]  # of localization, for one image or scan
