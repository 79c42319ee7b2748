"""Logins of local processes: created once, readable by their owner only, required on loopback routers only."""

import pytest
import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.security.logins import OPERATOR, USERS, login_of, make_logins, require_logins


@pytest.fixture
def security(tmp_path):
    make_logins(tmp_path / "logins", ("camera", OPERATOR))
    return SecurityConfig(local=tmp_path / "logins")


def test_logins_have_mode_600_and_existing_ones_are_kept(security):
    camera = login_of(security, "camera")
    assert len(camera.password) >= 32
    assert camera.password != login_of(security, OPERATOR).password
    assert {path.stat().st_mode & 0o777 for path in security.local.iterdir()} == {0o600}
    make_logins(security.local, ("camera", "depth"))
    assert login_of(security, "camera") == camera
    names = [line.split(":")[0] for line in (security.local / USERS).read_text().splitlines()]
    assert names == ["camera", OPERATOR, "depth"]


def test_missing_readable_or_invalid_login_files_raise(security):
    with pytest.raises(UserError, match=r"lidar.login is missing"):
        login_of(security, "lidar")
    (security.local / "camera.login").chmod(0o644)
    with pytest.raises(UserError, match="can be read by others"):
        login_of(security, "camera")
    (security.local / USERS).write_text("no password\n")
    with pytest.raises(UserError, match="no valid logins"):
        make_logins(security.local, ("depth",))


def test_only_a_loopback_router_requires_logins(security):
    config = zenoh.Config()
    require_logins(config, SecurityConfig(), ("tls/0.0.0.0:7448",))  # requires none
    with pytest.raises(UserError, match="can be reached from other hosts"):
        require_logins(config, security, ("tcp/127.0.0.1:7447", "tls/0.0.0.0:7448"))
    require_logins(config, security, ("tcp/127.0.0.1:7447",))
    assert str(security.local / USERS) in config.get_json("transport/auth/usrpwd/dictionary_file")
    assert '"deny"' in config.get_json("access_control")
    assert login_of(SecurityConfig(), "camera") is None
