"""The repository's top-level folders are installed as sub-packages of `beamsplat`; see pyproject.toml."""

from setuptools import find_packages, setup

API = "tools/api"  # `import beamsplat` itself
FOLDERS = ("common", "services", "tools", "deploy")

names = [name for folder in FOLDERS for name in (folder, *(f"{folder}.{p}" for p in find_packages(folder)))]
setup(
    packages=["beamsplat", *(f"beamsplat.{name}" for name in names if name != "tools.api")],
    package_dir={"beamsplat": API} | {f"beamsplat.{folder}": folder for folder in FOLDERS},
)
