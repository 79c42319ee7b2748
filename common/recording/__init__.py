"""Recordings as MCAP files: standard ROS 2 messages where they exist, BeamSplat messages for the rest."""

from beamsplat.common.recording.reader import RecordedMessage, RecordingReader, is_recording
from beamsplat.common.recording.writer import RecordingError, RecordingWriter

__all__ = ["RecordedMessage", "RecordingError", "RecordingReader", "RecordingWriter", "is_recording"]
