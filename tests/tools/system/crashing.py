"""A node that fails on its first step, and logs something afterwards."""

import logging

from beamsplat.common.runtime.node import Node


class Crashing(Node):
    name = "clock"
    outputs = ("tick",)

    def source(self):
        yield None
        1 / 0  # noqa: B018

    def close(self):
        logging.getLogger("beamsplat.crashing").info("closed in order")
