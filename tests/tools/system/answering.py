"""A localization node whose process answers hand-over requests with something else than expected."""

import time
from collections.abc import Iterator

import numpy as np

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.messages import Answer, Correction, Message
from beamsplat.common.runtime.control import HandoverControl
from tests.common.nodes import Chain


class Unknown(Message):
    """A message of a later version of the software."""


class AnsweringConfig(NodeConfig):
    verb: str = ""  # request with another answer
    answer: str = "text"
    sleep_s: float = 0.0  # per scan


ANSWERS = {
    "text": Answer(stamp_ns=0, text="soon"),
    "a list": Answer(stamp_ns=0, text="[1, 2]"),
    "another message": Correction(stamp_ns=0, T_map_odom=np.eye(4)),
    "an unknown message": Unknown(stamp_ns=0),
}


class Answering(Chain):
    """Can be replaced while it runs."""

    Config = AnsweringConfig
    config: AnsweringConfig
    replaceable = True

    def configure(self) -> None:
        super().configure()
        config, answer = self.config, HandoverControl.answer

        def wrong(control: HandoverControl, verb: str, parameters: dict[str, str]) -> Iterator[Message]:
            right = list(answer(control, verb, parameters))
            yield from [ANSWERS[config.answer]] if verb == config.verb else right

        HandoverControl.answer = wrong

    def on_lidar_scan(self, message):
        time.sleep(self.config.sleep_s)
        yield from super().on_lidar_scan(message)
