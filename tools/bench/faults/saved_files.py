"""Read what a campaign's processes have saved: the mapper's session and the robot's lidar map."""

from __future__ import annotations

import time
from pathlib import Path

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.state import MANIFEST, load_state
from beamsplat.tools.bench.faults.hosts import CampaignHosts, Role

_ATTEMPTS = 4  # the files may be replaced while they are read
_PAUSE_S = 0.5


def unreadable(hosts: CampaignHosts, everything: bool = False) -> dict[Role, list[str]]:
    """Return why saved files cannot be read, by host; empty lists if all can.

    Args:
        hosts: their files may be written meanwhile.
        everything: also read the file of every keyframe.
    """
    session = SessionFolder(Path(hosts.edge.deployment.nodes["mapping"]["session"]))
    lidar_map = hosts.robot.deployment.run_dir / "localization"
    return {"edge": _session_faults(session, everything), "robot": _lidar_map_faults(lidar_map)}


def _session_faults(session: SessionFolder, everything: bool) -> list[str]:
    """Return why a session cannot be read; nothing if there is none yet."""
    if not session.exists():
        return []
    found = []
    for attempt in range(_ATTEMPTS):
        try:
            session.read_state()
            break
        except UserError as error:
            if attempt == _ATTEMPTS - 1:
                found.append(str(error))
            time.sleep(_PAUSE_S)
    for id in session.keyframe_ids() if everything else ():
        try:
            session.read_keyframe(id)
        except UserError as error:
            found.append(str(error))
    return found


def _lidar_map_faults(folder: Path) -> list[str]:
    """Return why a lidar map cannot be read; nothing if there is none yet."""
    for attempt in range(_ATTEMPTS):
        if not (folder / MANIFEST).is_file():
            return []
        try:
            load_state(folder, LidarSlamSettings())
            return []
        except UserError as error:
            if attempt == _ATTEMPTS - 1:
                return [str(error)]
            time.sleep(_PAUSE_S)
    return []
