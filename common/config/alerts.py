"""Options of alerts: when they begin and end, and where they are sent."""

from __future__ import annotations

from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import Field, SecretStr, field_validator

from beamsplat.common.config.base import Config, parse
from beamsplat.common.config.deployment import Deployment

# lost: localization has no pose. link_down: the link to the edge server, or the whole other host, is silent.
AlertKind = Literal["lost", "link_down", "disk_nearly_full", "calibration_doubt", "node_failed"]
HoldSeconds = Annotated[float, Field(ge=0.0, le=86400.0)]


class AlertConfig(Config):
    """Options of alerts, table `[nodes.page.alerts]`: conditions, and the webhook that they are sent to.

    The webhook receives one JSON object by HTTP POST when an alert begins, and one when it ends.
    """

    hold_s: HoldSeconds = 10.0  # an alert begins after its condition has held for so long
    clear_s: HoldSeconds = 10.0  # it ends after the condition was absent for so long
    disk_free_mb: Annotated[float, Field(ge=0.0)] = 1000.0  # less free space is "nearly full"
    off: tuple[AlertKind, ...] = ()  # kinds of alerts that are not wanted
    webhook: SecretStr = SecretStr("")  # http:// or https:// address; "": alerts are shown only
    webhook_token: SecretStr = SecretStr("")  # sent as "Authorization: Bearer TOKEN"

    @field_validator("webhook")
    @classmethod
    def _is_address(cls, webhook: SecretStr) -> SecretStr:
        address = webhook.get_secret_value()
        if not address:
            return webhook
        try:
            parts = urlsplit(address)
            usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:  # a port that is no number
            usable = False
        if not usable or not address.isascii() or any(c.isspace() for c in address):
            raise ValueError("use an address such as https://HOST/PATH")
        return webhook


def alert_rules(deployment: Deployment, where: str) -> AlertConfig:
    """Return the rules of a deployment: the table `alerts` of its page, or the defaults.

    Raises:
        UserError: the table is invalid; `where` names its source.
    """
    table = deployment.nodes.get("page", {}).get("alerts", {})
    rules: AlertConfig = parse(AlertConfig, table, where, "page.alerts.")
    return rules
