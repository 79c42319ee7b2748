"""Shipped deployments are found by name where the working directory has no such file."""

from pathlib import Path

import pytest

from beamsplat.common.files.resources import deployment_file, shipped_file


@pytest.mark.parametrize("name", ["deploy/demo.toml", "demo.toml", "demo"])
def test_a_shipped_deployment_is_found_from_an_empty_directory(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert deployment_file(Path(name)) == shipped_file("demo.toml")
    assert shipped_file("demo.toml").is_file()


def test_a_file_of_the_working_directory_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo.toml").touch()
    assert deployment_file(Path("demo.toml")) == Path("demo.toml")


@pytest.mark.parametrize("name", ["nowhere.toml", "../pyproject.toml", "/nowhere/demo.toml"])
def test_other_names_stay_as_they_are(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert deployment_file(Path(name)) == Path(name)
