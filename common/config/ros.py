"""Options that all nodes which speak to ROS 2 share."""

from __future__ import annotations

import os
from typing import Annotated, Any

from pydantic import Field

ROUTER = "tcp/127.0.0.1:7447"  # the default endpoint of rmw_zenohd, and of our own router

Domain = Annotated[int, Field(ge=0, le=232)]


def domain_field() -> Any:
    """Return a pydantic field whose default is the environment's ROS_DOMAIN_ID, else 0, as in ROS."""
    return Field(default_factory=_domain, validate_default=True)


def _domain() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "")
    return int(text) if text.isdigit() else 0
