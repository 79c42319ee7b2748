"""Fixtures to read .rrd files, and rerun in strict mode, so that invalid entries raise."""

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader


class RrdFile:
    """The content of a .rrd file."""

    def __init__(self, path):
        reader = RrdReader(path)
        (entry,) = reader.recordings()
        self.blueprints = len(reader.blueprints())
        self.application = entry.application_id
        self._chunks = {}
        for chunk in reader.stream(store=entry).to_chunks():
            self._chunks.setdefault(str(chunk.entity_path).strip("/"), []).append(chunk)

    @property
    def entities(self):
        return {path for path in self._chunks if not path.startswith("__")}

    def rows(self, entity):
        """Return the rows (column name -> value) of an entity in order of time."""
        found = []
        for chunk in self._chunks.get(entity, []):
            batch = chunk.to_record_batch()
            for i in range(batch.num_rows):
                found.append({name: batch.column(name)[i] for name in batch.schema.names})
        return sorted(found, key=lambda row: row["time"].value if "time" in row else -1)

    def stamps(self, entity):
        return [row["time"].value for row in self.rows(entity) if "time" in row]

    def column(self, entity, part):
        """Return the values of the component whose name contains `part`, one array per row that has it."""
        values = []
        for row in self.rows(entity):
            for name, value in row.items():
                if part in name and value.as_py() is not None:
                    values.append(np.array(value.as_py()))
        return values


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture
def read_rrd():
    return RrdFile
