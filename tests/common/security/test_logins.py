"""Logins of the processes of one host: made once, readable by their owner only, asked for on loopback only."""

import pytest
import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.security.logins import OPERATOR, USERS, login_of, make_logins, require_logins


@pytest.fixture
def security(tmp_path):
    make_logins(tmp_path / "logins", ("camera", OPERATOR))
    return SecurityConfig(local=tmp_path / "logins")


def test_a_login_is_its_owners_only_and_stays_when_others_are_made(security):
    camera = login_of(security, "camera")
    assert len(camera.password) >= 32
    assert camera.password != login_of(security, OPERATOR).password
    assert {path.stat().st_mode & 0o777 for path in security.local.iterdir()} == {0o600}
    make_logins(security.local, ("camera", "depth"))
    assert login_of(security, "camera") == camera
    names = [line.split(":")[0] for line in (security.local / USERS).read_text().splitlines()]
    assert names == ["camera", OPERATOR, "depth"]


def test_what_is_missing_open_to_others_or_broken_is_refused(security):
    with pytest.raises(UserError, match=r"lidar.login is missing"):
        login_of(security, "lidar")
    (security.local / "camera.login").chmod(0o644)
    with pytest.raises(UserError, match="can be read by others"):
        login_of(security, "camera")
    (security.local / USERS).write_text("no password\n")
    with pytest.raises(UserError, match="no valid logins"):
        make_logins(security.local, ("depth",))


def test_only_a_router_without_doors_to_other_hosts_asks_for_logins(security):
    config = zenoh.Config()
    require_logins(config, SecurityConfig(), ("tls/0.0.0.0:7448",))  # asks for none
    with pytest.raises(UserError, match="can be reached from other hosts"):
        require_logins(config, security, ("tcp/127.0.0.1:7447", "tls/0.0.0.0:7448"))
    require_logins(config, security, ("tcp/127.0.0.1:7447",))
    assert str(security.local / USERS) in config.get_json("transport/auth/usrpwd/dictionary_file")
    assert '"deny"' in config.get_json("access_control")
    assert login_of(SecurityConfig(), "camera") is None
