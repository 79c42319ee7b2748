"""The documentation: its links exist, and its commands exist with the options that it shows."""

import re
import shlex
import subprocess
from pathlib import Path

import pytest
import typer

from beamsplat.tools.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    path
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / ".github").rglob("*.md"))
    if path.is_file()
)
GENERATED = {"reference/commands.md", "reference/options.md", "reference/topics.md", "reference/api.md"}
_LINK = re.compile(r"!?\[[^\]\n]*\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^ *```.*?^ *```", re.MULTILINE | re.DOTALL)
_END = re.compile(r"[|;&<>]|\s#\s|$")  # where a shell command ends


def _id(path):
    return path.relative_to(ROOT).as_posix()


def _anchors(path):
    """The anchors that GitHub and the site make of the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", _FENCE.sub("", path.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=_id)
def test_relative_links_exist(page):
    broken = []
    for link in _LINK.findall(_FENCE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if target.is_relative_to(ROOT / "docs") and target.relative_to(ROOT / "docs").as_posix() in GENERATED:
            continue
        if not target.exists() or (anchor and anchor not in _anchors(target)):
            broken.append(link)
    assert not broken


def commands_in(text):
    """Yield the words of each `beamsplat ...` command line in code blocks, and in `code` with a command."""
    blocks = _FENCE.findall(text)
    rest = _FENCE.sub("", text)
    lines = [line for block in blocks if "mermaid" not in block for line in _joined(block)]
    lines += [line for line in _joined(rest) if line.startswith("    ")]
    prose = "\n".join(line for line in rest.splitlines() if not line.startswith("    "))
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    for source in (*lines, *spans):
        found = re.match(r"(?:.*?[\s(/]|[A-Z_]+=\S+ )??(?:\.venv/bin/)?beamsplat ([a-z].*)$", f"{source}")
        if found and "import" not in source and "pip install" not in source:
            words = shlex.split(_END.split(found[1])[0])
            if words:
                yield words


def _joined(block):
    """Lines of a block; a line that ends with a backslash continues."""
    return re.sub(r"\\\n\s*", "", block).splitlines()


def fault_of(words):
    """Return what is wrong with a command line, "" if nothing: unknown command, option or missing value."""
    command = typer.main.get_command(app)
    words = [w for w in words if w not in ("...", "[...]")]
    path = "beamsplat"
    while hasattr(command, "commands"):
        if not words or words[0].isupper():
            return ""  # it names a group, or `beamsplat COMMAND`
        if words[0] not in command.commands:
            return f"{path}: no command {words[0]!r}"
        path, command = f"{path} {words[0]}", command.commands[words.pop(0)]
    options = {
        name: p for p in command.params for name in (*p.opts, *p.secondary_opts) if name.startswith("-")
    }
    arguments = 0
    while words:
        word, equals, _ = words.pop(0).partition("=")
        if not word.startswith("--"):
            arguments += 1
        elif word == "--help":
            continue
        elif word not in options:
            return f"{path}: no option {word!r}"
        elif not getattr(options[word], "is_flag", False) and not equals:
            if not words:
                return f"{path}: {word} needs a value"
            words.pop(0)
    places = [p for p in command.params if not any(name.startswith("-") for name in p.opts)]
    most = 1000 if any(p.nargs == -1 for p in places) else len(places)
    if arguments > most:
        return f"{path}: {arguments} arguments, at most {most} are possible"
    return ""


@pytest.mark.parametrize("page", [p for p in PAGES if p.name != "CHANGELOG.md"], ids=_id)
def test_commands_and_options_exist(page):
    lines = list(commands_in(page.read_text()))
    assert [f"{shlex.join(words)}: {fault}" for words in lines if (fault := fault_of(list(words)))] == []


def test_command_lines_are_found_and_checked():
    text = """
    beamsplat run deploy/demo.toml --set replay.data=x   # comment
    ROS_DOMAIN_ID=9 .venv/bin/beamsplat run FILE \\
        --rate 2 > log
Text with `beamsplat top FILE --all` in it, `import beamsplat` and `beamsplat.common`.
"""
    found = list(commands_in(text))
    assert ["run", "FILE", "--rate", "2"] in found
    assert ["top", "FILE", "--all"] in found
    assert len(found) == 3
    assert [fault_of(list(words)) for words in found] == ["", "", ""]
    assert "no command 'walk'" in fault_of(["walk"])
    assert "no option '--fast'" in fault_of(["run", "FILE", "--fast"])
    assert "needs a value" in fault_of(["run", "FILE", "--rate"])
    assert "arguments" in fault_of(["check", "FILE", "OTHER"])


def test_the_readme_has_enough_commands_to_be_checked():
    assert len(list(commands_in((ROOT / "README.md").read_text()))) > 25


def test_the_site_lists_every_page():
    listed = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    written = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert written <= listed
    assert listed - written <= GENERATED | {"architecture.md", "contributing.md", "changelog.md"}


@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path):
    subprocess.run(["make", "build/typed"], cwd=ROOT, check=True, capture_output=True)
    done = subprocess.run(
        [str(ROOT / ".venv/bin/mkdocs"), "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
