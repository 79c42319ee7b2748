"""`doctor --security` reports the reason of every refused link, which Zenoh does not."""

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import KEY, SecurityConfig
from beamsplat.common.zenoh.bus import open_router
from beamsplat.tools.keys.link_diagnosis import diagnose_security
from beamsplat.tools.keys.pki import CertificateAuthority
from tests.conftest import free_port


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    made = CertificateAuthority.create(tmp_path_factory.mktemp("authority"))
    made.issue("edge", HostRole(role="edge"), ("127.0.0.1",))
    made.issue("r1", HostRole(role="robot", robot="r1"))
    return made


@pytest.fixture(scope="module")
def router_endpoint(authority):
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with open_router((endpoint,), security=SecurityConfig(keys=authority.folder / "hosts" / "edge")):
        yield endpoint


def robot(endpoint, keys):
    return Deployment(nodes={"uplink": {"edge": endpoint}}, security=SecurityConfig(keys=keys))


def faults(deployment):
    return [
        text for _, verdict, text, remedy in diagnose_security(deployment) if verdict == "fault" and remedy
    ]


def test_a_valid_link_is_reported_as_ok(authority, router_endpoint):
    remarks = list(diagnose_security(robot(router_endpoint, authority.folder / "hosts" / "r1")))
    assert any(v == "ok" and "accepts this host's certificate" in text for _, v, text, _ in remarks)
    assert any("r1: valid for" in text for _, _, text, _ in remarks)
    assert not faults(robot(router_endpoint, authority.folder / "hosts" / "r1"))


def test_certificates_of_another_authority(authority, router_endpoint, tmp_path):
    other = CertificateAuthority.create(tmp_path)
    folder = other.issue("r1", HostRole(role="robot", robot="r1"))
    assert any(
        "the edge's certificate is not valid" in text for text in faults(robot(router_endpoint, folder))
    )
    (folder / "ca.pem").write_bytes((authority.folder / "ca.pem").read_bytes())
    found = faults(robot(router_endpoint, folder))
    assert any("was not issued by" in text for text in found)
    assert any("rejects this host's certificate" in text for text in found)


def test_an_address_that_is_not_in_the_certificate(authority, router_endpoint):
    endpoint = router_endpoint.replace("127.0.0.1", "localhost")
    found = faults(robot(endpoint, authority.folder / "hosts" / "r1"))
    assert any("ostname mismatch" in text for text in found)


def test_no_answer_and_unknown_host_name(authority):
    keys = authority.folder / "hosts" / "r1"
    assert any("cannot be reached" in text for text in faults(robot(f"tls/127.0.0.1:{free_port()}", keys)))
    assert any("cannot be resolved" in text for text in faults(robot("tls/nowhere.invalid:7448", keys)))


def test_missing_readable_and_unprotected(authority, tmp_path):
    assert any(
        "needs the host's keys" in t for t in faults(Deployment(nodes={"uplink": {"edge": "tls/x:1"}}))
    )
    assert any("is missing" in t for t in faults(robot("tls/127.0.0.1:1", tmp_path)))
    unprotected = Deployment(router=RouterConfig(listen=("tcp/0.0.0.0:7447",)))
    assert any("unprotected" in t for t in faults(unprotected))
    remarks = list(diagnose_security(unprotected.model_copy(update={"security": SecurityConfig(plain=True)})))
    assert [verdict for _, verdict, _, _ in remarks] == ["note"]
    folder = authority.issue("loose", HostRole(role="robot", robot="loose"))
    (folder / KEY).chmod(0o644)
    assert any("can be read by others" in t for t in faults(robot("tls/127.0.0.1:1", folder)))


def test_the_edge_lists_the_roles_of_all_hosts(authority):
    edge = Deployment(
        router=RouterConfig(listen=("tcp/127.0.0.1:1", "tls/0.0.0.0:2")),
        security=SecurityConfig(keys=authority.folder / "hosts" / "edge"),
    )
    texts = [text for _, _, text, _ in diagnose_security(edge)]
    assert any(text == "r1: robot of r1" for text in texts)
    assert any("edge: edge of all robots" in text for text in texts)


def test_a_certificate_that_expires_soon_is_noted(authority, router_endpoint):
    folder = authority.issue("brief", HostRole(role="robot", robot="brief"), days=3)
    remarks = list(diagnose_security(robot(router_endpoint, folder)))
    assert any(v == "note" and "expires in 3 days" in text for _, v, text, _ in remarks)
