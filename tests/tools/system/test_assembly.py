"""What a deployment would run, and what is wrong with one that would not."""

from pathlib import Path

import pytest

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.assembly import build_node, faults, node_classes, surroundings
from beamsplat.tools.system.graph import as_mermaid, as_text, edges
from tests.common.nodes import TABLE

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("path", sorted((ROOT / "deploy").glob("*.toml")), ids=lambda p: p.name)
def test_shipped_deployments_fit_together(path):
    if path.name == "models.toml":
        pytest.skip("a table of models, not a deployment")
    needed = ("replay.data=somewhere", "recorder.out=somewhere")
    nodes = load_deployment(path).nodes
    deployment = load_deployment(path, tuple(x for x in needed if x.partition(".")[0] in nodes))
    assert [fault.text for fault in faults(deployment) if fault.fatal] == []


@pytest.mark.parametrize("service", NODES.values(), ids=lambda s: s.name)
def test_every_kind_in_the_process_list_loads_under_its_own_name(service):
    for kind in service.kinds:
        assert service.load(kind).name == service.name


def test_faults_are_found():
    assert "no such service" in faults(Deployment(nodes={"ghost": {}}))[0].text
    assert "no kind 'sonar'" in faults(Deployment(nodes={"localization": {"kind": "sonar"}}))[0].text
    lonely = faults(Deployment(nodes={"localization": {"kind": "chain"}}), TABLE)
    assert [f.fatal for f in lonely] == [False]
    assert "nothing in this deployment feeds localization" in lonely[0].text
    with pytest.raises(UserError, match="has no node 'depth'"):
        build_node(Deployment(), "depth")


def test_a_source_waits_for_all_who_listen():
    nodes = {"replay": {}, "localization": {"kind": "chain"}, "recorder": {}}
    deployment = Deployment(nodes=nodes)
    classes = node_classes(deployment, TABLE)
    assert surroundings(classes, "replay").wait_for == {"localization", "recorder"}
    assert surroundings(classes, "recorder").without_producer == {"localization/grid"}
    assert surroundings(classes, "localization").wait_for == set()


def test_the_graph_shows_every_connection():
    nodes = {"replay": {}, "localization": {"kind": "chain"}, "recorder": {}}
    classes = node_classes(Deployment(nodes=nodes), TABLE)
    assert ("replay", "lidar/scan", "localization", "every") in edges(classes)
    assert len(edges(classes)) == 4
    mermaid = as_mermaid(classes)
    assert "replay -->|wheel/odometry<br>lidar/scan| localization" in mermaid
    assert "camera/image" in as_text(classes)
    assert "(nobody)" in as_text(classes)


def test_the_dataflow_in_the_readme_is_the_one_that_runs():
    deployment = load_deployment(ROOT / "deploy/demo.toml", ("replay.data=x", "recorder.out=x"))
    drawn = as_mermaid(node_classes(deployment))
    assert f"```mermaid\n{drawn}\n```" in (ROOT / "README.md").read_text(), (
        "update the block with `beamsplat graph deploy/demo.toml --mermaid`"
    )
