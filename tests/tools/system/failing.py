"""A whole system whose localization cannot run, at the start or after some messages.

python -m tests.tools.system.failing DEPLOYMENT.json
"""

import sys
from pathlib import Path

from beamsplat.common.config.deployment import Deployment, NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.node import Outputs
from beamsplat.common.runtime.registry import Service
from tests.common.nodes import TABLE, Chain

FAILS_AFTER_NS = 6_000_000_000  # stamp; the drive begins at 1 s


class FailingConfig(NodeConfig):
    fails_in_configure: bool = False
    needs: Path | None = None  # after some messages, every message is an error while this file is missing


class Failing(Chain):
    """Localization with a UserError in `configure`, or after some messages."""

    Config = FailingConfig
    config: FailingConfig

    def configure(self) -> None:
        super().configure()
        if self.config.fails_in_configure:
            raise UserError("the wall height is negative")

    def on_lidar_scan(self, message) -> Outputs:
        file = self.config.needs
        if file is not None and message.stamp_ns > FAILS_AFTER_NS and not file.exists():
            raise UserError(f"{file} has gone")
        yield from super().on_lidar_scan(message)


def main() -> None:
    """Run the deployment with `run_checked`; a UserError is printed, exit code 2."""
    from beamsplat.services import nodes
    from beamsplat.tools.cli.system import run_checked

    own = Service("localization", "", {"failing": "tests.tools.system.failing:Failing"})
    nodes.NODES.update({**TABLE, "localization": own})
    try:
        run_checked(Deployment.model_validate_json(Path(sys.argv[1]).read_text()))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
