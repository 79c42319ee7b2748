"""What ROS 2 receives: a whole grid, then updates that refer to it, and a whole grid again in time."""

import numpy as np

from beamsplat.common.mapfiles.grid_tiles import GridSource, pack_tile
from beamsplat.services.ros2_out import conversions, grid_publisher
from beamsplat.services.ros2_out.grid_publisher import GridPublisher

SOURCE, SIZE = GridSource("a", 1, 0.05, 16), 16


class Nav2:
    """Applies the messages as nav2's static layer does."""

    def __init__(self):
        self.cells, self.origin, self.kinds = None, None, []

    def take(self, messages):
        for name, m in messages:
            self.kinds.append(name)
            if name == "map":
                self.cells = np.array(m.data).reshape(m.info.height, m.info.width)
                self.origin = m.info.origin.position.x, m.info.origin.position.y
            else:
                part = np.asarray(m.data).reshape(m.height, m.width)
                self.cells[m.y : m.y + m.height, m.x : m.x + m.width] = part


def cells(seed):
    return np.random.default_rng(seed).integers(-1, 101, (SIZE, SIZE)).astype(np.int8)


def test_updates_keep_a_map_current_between_whole_maps():
    publisher, robot = GridPublisher("map", 5.0), Nav2()
    publisher.add(SOURCE, 0, 0, pack_tile(cells(0)))
    publisher.add(SOURCE, -1, 1, pack_tile(cells(1)))
    robot.take(publisher.messages(0))
    assert (robot.kinds, robot.origin) == (["map"], (0.0, -0.8))
    publisher.add(SOURCE, 0, 0, pack_tile(cells(2)))
    robot.take(publisher.messages(10**9))
    assert robot.kinds == ["map", "map_updates"]
    publisher.add(SOURCE, 0, 0, pack_tile(cells(2)))  # repeated for late subscribers
    robot.take(publisher.messages(2 * 10**9))
    assert robot.kinds == ["map", "map_updates"]
    np.testing.assert_array_equal(robot.cells[SIZE:, :SIZE], cells(2))
    np.testing.assert_array_equal(robot.cells[:SIZE, SIZE:], cells(1))
    assert (robot.cells[SIZE:, SIZE:] == -1).all()
    publisher.add(SOURCE, 0, 1, pack_tile(cells(4)))
    robot.take(publisher.messages(3 * 10**9))
    publisher.add(SOURCE, 0, 1, b"")  # after a loop closure
    robot.take(publisher.messages(4 * 10**9))
    assert (robot.cells[SIZE:, SIZE:] == -1).all()
    publisher.add(SOURCE, 0, 0, pack_tile(cells(3)))
    robot.take(publisher.messages(6 * 10**9))
    assert robot.kinds[-1] == "map"  # 5 s after the last one: a later node must not be given an older map
    publisher.add(SOURCE, 5, 0, pack_tile(cells(3)))
    robot.take(publisher.messages(7 * 10**9))
    assert robot.kinds[-1] == "map"  # it has grown
    assert robot.cells.shape == (7 * SIZE, 2 * SIZE)
    publisher.add(GridSource("a", 99, 0.05, 16), 0, 0, pack_tile(cells(5)))  # the producer was restarted
    robot.take(publisher.messages(8 * 10**9))
    np.testing.assert_array_equal(robot.cells, cells(5))


def test_a_large_map_is_sent_whole_less_often(monkeypatch):
    monkeypatch.setattr(grid_publisher, "_CELLS_PER_S", 2 * SIZE**2 / 20.0)  # two tiles: every 20 s
    publisher, robot = GridPublisher("map", 5.0), Nav2()
    publisher.add(SOURCE, 0, 1, pack_tile(cells(0)))
    for second in range(41):
        publisher.add(SOURCE, 0, 0, pack_tile(cells(second)))
        robot.take(publisher.messages(second * 10**9))
    assert [second for second, kind in enumerate(robot.kinds) if kind == "map"] == [0, 20, 40]
    np.testing.assert_array_equal(robot.cells[:, :SIZE], cells(40))


def test_the_update_is_the_message_of_map_msgs():
    m = conversions.grid_update(3, "map", 7, 9, np.arange(6, dtype=np.int8).reshape(2, 3))
    assert (m.y, m.x, m.height, m.width, m.data.tolist()) == (7, 9, 2, 3, list(range(6)))
    assert m.__msgtype__ == "map_msgs/msg/OccupancyGridUpdate"
