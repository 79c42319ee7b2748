"""MkDocs hook: generates the reference pages from the code, so that they cannot differ from it.

reference/commands.md   from the Typer application
reference/options.md    from the Config classes of all services
reference/topics.md     from the topic table and the message classes
reference/api.md        from the public names of `beamsplat`
"""

from __future__ import annotations

import ast
import html
import inspect
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pydantic import BaseModel, SecretStr
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

import beamsplat
from beamsplat.common.config.base import remote_options
from beamsplat.common.config.deployment import Deployment, NodeConfig, RouterConfig
from beamsplat.common.messages.schema import Array, Message, MessagePart
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.topics import TOPICS
from beamsplat.services.depth.source import SOURCES, source_class
from beamsplat.services.nodes import NODES
from beamsplat.tools.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
_BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
_LINK = re.compile(r"\[(?P<text>[^\]\n]+)\]\((?P<target>[^)\s]+)\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the site."""
    pages = {"commands": commands(), "options": options(), "topics": topics(), "api": api()}
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    for name in ("ARCHITECTURE", "CONTRIBUTING", "CHANGELOG"):
        files.append(File.generated(config, f"{name.lower()}.md", content=_from_root(f"{name}.md")))
    return files


def _from_root(name: str) -> str:
    """Return a page of the repository's root with links as from docs/."""

    def replace(match: re.Match[str]) -> str:
        target = match["target"]
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        inside = re.sub(r"^(ARCHITECTURE|CONTRIBUTING|CHANGELOG)\.md", lambda page: page[0].lower(), target)
        inside = (
            inside.removeprefix("docs/") if inside != target or target.startswith("docs/") else f"../{target}"
        )
        return f"[{match['text']}]({inside})"

    return _LINK.sub(replace, (ROOT / name).read_text())


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace links to files of the repository outside docs/, which the site does not contain, by their text.

    With `repo_url` in mkdocs.yml they become links to the repository.
    """

    def replace(match: re.Match[str]) -> str:
        text, target = match["text"], match["target"]
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        folder = Path(page.file.src_uri).parent
        path = os.path.normpath(Path("docs") / folder / target.partition("#")[0])
        if path.startswith("docs/"):
            return match[0]
        return f"[{text}]({config.repo_url.rstrip('/')}/blob/main/{path})" if config.repo_url else text

    return _LINK.sub(replace, markdown)


# --- commands ----------------------------------------------------------------------------------------------


def commands() -> str:
    """Return the page of all commands: an overview by group, then every command with all its options."""
    program = [
        sys.executable,
        "-m",
        "typer",
        "beamsplat.tools.cli.main",
        "utils",
        "docs",
        "--name",
        "beamsplat",
    ]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    body = done.stdout[done.stdout.index("\n## ") :]
    # The overviews of Typer cut sentences; code blocks need no entities.
    body = re.sub(r"\*\*Commands\*\*:\n\n(\* .*\n)+\n", "", body)
    body = re.sub(r"^ {4}.*$", lambda line: html.unescape(line[0]), body, flags=re.MULTILINE)
    rows = ["# Commands", "", "`beamsplat COMMAND --help` prints the same text.", ""]
    panels: dict[str, list[tuple[str, str]]] = {}
    root: Any = typer.main.get_command(app)
    for name, command in root.commands.items():
        panel = panels.setdefault(str(command.rich_help_panel), [])
        for sub, child in getattr(command, "commands", {"": command}).items():
            panel.append((f"{name} {sub}".strip(), _first_sentence(child.help)))
    for panel_name, entries in panels.items():
        rows += [f"**{panel_name}**", "", "| command | |", "|---|---|"]
        rows += [
            f"| [`{name}`](#beamsplat-{name.replace(' ', '-')}) | {_cell(text)} |" for name, text in entries
        ]
        rows.append("")
    return "\n".join(rows) + body


def _first_sentence(text: str | None) -> str:
    return " ".join((text or "").split("\n\n")[0].split())


# --- options -----------------------------------------------------------------------------------------------


def options() -> str:
    """Return the page of all options of a deployment file."""
    rows = [
        "# Options of a deployment",
        "",
        "A deployment is a TOML file. Unknown options and values of a wrong type are errors; "
        "`beamsplat check FILE` finds them. On the command line, `--set NODE.OPTION=VALUE` overrides one.",
        "",
        "Options with *remote* = yes can be changed while the system runs from the page and from other hosts "
        "with the role operator. The others can be changed on the node's own host only (`beamsplat swap`).",
        "",
        *_section("Top level of the file", Deployment, own=Deployment),
        *_section("Table [router]", RouterConfig, own=RouterConfig),
        *_section("Table [security]", SecurityConfig, own=SecurityConfig),
        *_section("Options of every node", NodeConfig, own=NodeConfig),
    ]
    for service in NODES.values():
        rows += [f"## nodes.{service.name}", "", f"The service {service.summary}.", ""]
        for kind in service.kinds:
            config = service.load(kind).Config
            if len(service.kinds) > 1:
                rows += [f'### kind = "{kind}"', ""]
            if config is NodeConfig:
                rows += ["No options of its own.", ""]
            else:
                rows += [*_docstring(config), *_options_table(config)]
                rows += _tables_within(f"nodes.{service.name}", config)
    rows += ["## Depth sources", "", "`[nodes.depth]` with `source = NAME` and `options = { ... }`.", ""]
    for name in SOURCES:
        rows += [
            f'### source = "{name}"',
            "",
            *_docstring(source_class(name)),
            *_parameters(source_class(name)),
        ]
    return "\n".join(rows)


def _tables_within(table: str, config: type[BaseModel]) -> list[str]:
    """Return a section for each option of a node that is a table itself."""
    rows: list[str] = []
    for name, field in config.model_fields.items():
        if isinstance(inner := field.annotation, type) and issubclass(inner, BaseModel):
            rows += [f"### Table [{table}.{name}]", "", *_docstring(inner), *_options_table(inner, own=inner)]
    return rows


def _section(title: str, config: type[BaseModel], own: type) -> list[str]:
    return [f"## {title}", "", *_docstring(config), *_options_table(config, own)]


def _options_table(config: type[BaseModel], own: type | None = None) -> list[str]:
    """Return a table of the options; those that all nodes have are left out unless `own` is their class."""
    comments = comments_of(config)
    remote = remote_options(config)
    rows = ["| option | type | default | remote | |", "|---|---|---|---|---|"]
    for name, field in config.model_fields.items():
        if (
            own is None
            and name in NodeConfig.model_fields
            and field.default == NodeConfig.model_fields[name].default
        ):
            continue
        rows.append(
            f"| `{name}` | {_cell(type_name(field))} | {_default(field)} | {'yes' if name in remote else ''} "
            f"| {_cell(comments.get(name, ''))} |"
        )
    return [*rows, ""]


def _parameters(source: type) -> list[str]:
    """Return a table of the options of a depth source: the parameters of its constructor."""
    parameters = inspect.signature(source).parameters.values()
    if not parameters:
        return ["No options.", ""]
    rows = ["| option | type | default |", "|---|---|---|"]
    for parameter in parameters:
        default = "required" if parameter.default is parameter.empty else f"`{_toml(parameter.default)}`"
        rows.append(f"| `{parameter.name}` | `{parameter.annotation}` | {default} |")
    return [*rows, ""]


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return "none"
    if isinstance(value, BaseModel):
        return "see below"
    return f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, SecretStr):
        value = value.get_secret_value()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | Path):
        return f'"{value}"'
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return str(value)


# --- topics and messages -----------------------------------------------------------------------------------


def topics() -> str:
    """Return the page of all topics and the messages that they carry."""
    readers: dict[str, list[str]] = {name: [] for name in TOPICS}
    for service in NODES.values():
        for entry in {i.topic for kind in service.kinds for i in service.load(kind).inputs}:
            readers[entry].append(service.name)
    table = sys.modules["beamsplat.common.topics"].__doc__ or ""
    rows = [
        "# Topics and messages",
        "",
        "The keys of a running system are `beamsplat/<robot>/<topic>`. `uplink` says what crosses between "
        "robot and edge server. In addition, each node publishes its health once a second.",
        "",
        "| topic | message | published by | Hz | delivery | uplink | received by |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in TOPICS.values():
        message = row.message.__name__
        rate = f"{row.rate_hz:g}" if row.rate_hz else "on events"
        rows.append(
            f"| `{row.name}` | [{message}](#{message.lower()}) | {', '.join(row.producers)} | {rate} | "
            f"{row.delivery} | {row.uplink or '-'} | {', '.join(readers[row.name])} |"
        )
    deliveries = table[table.index("latest ") : table.index("`uplink`")].strip()
    rows += ["", "```text", deliveries, "```", "", "## Messages", ""]
    rows += ["`stamp_ns` is a field of every message: time of measurement, int64 nanoseconds.", ""]
    for message_class in sorted(_subclasses(Message), key=lambda c: c.__name__):
        rows += [f"### {message_class.__name__}", "", f"Version {message_class.version}.", ""]
        rows += [*_docstring(message_class), *_fields(message_class)]
    rows += ["## Parts of messages", ""]
    for part in sorted(
        set(_subclasses(MessagePart)) - set(_subclasses(Message)) - {Message}, key=lambda c: c.__name__
    ):
        rows += [f"### {part.__name__}", "", *_docstring(part), *_fields(part)]
    return "\n".join(rows)


def _subclasses(cls: type) -> Iterator[Any]:
    for child in cls.__subclasses__():
        if child.__module__.startswith("beamsplat."):
            yield child
            yield from _subclasses(child)


def _fields(message: type[BaseModel]) -> list[str]:
    comments = comments_of(message)
    rows = ["| field | type | |", "|---|---|---|"]
    for name, field in message.model_fields.items():
        if name != "stamp_ns":
            rows.append(f"| `{name}` | {_cell(type_name(field))} | {_cell(comments.get(name, ''))} |")
    return [*rows, ""] if len(rows) > 2 else ["No further fields.", ""]


# --- Python API --------------------------------------------------------------------------------------------


def api() -> str:
    """Return the page of the public names, each documented by mkdocstrings where it is defined."""
    lines = ["# Python API", "", *textwrap.dedent(beamsplat.__doc__ or "").splitlines()[2:], ""]
    lines += [f"Public names: {', '.join(f'`{name}`' for name in beamsplat.__all__)}.", ""]
    for name in beamsplat.__all__:
        module = beamsplat._MODULE_OF[name]
        lines += [f"::: {module}.{name}", ""]
    return "\n".join(lines)


# --- reading the sources -----------------------------------------------------------------------------------


def type_name(field: FieldInfo) -> str:
    """Return the type of a field in one line of Markdown, with its bounds or array shape."""
    arrays = [entry for entry in field.metadata if isinstance(entry, Array)]
    if arrays:
        return f"`{arrays[0].dtype} [{', '.join(map(str, arrays[0].shape))}]`"
    bounds: list[str] = []
    name = _annotation(field.annotation, bounds)
    bounds += _bounds(field.metadata)
    return f"`{name}`" + (f", {', '.join(bounds)}" if bounds else "")


def _annotation(annotation: Any, bounds: list[str]) -> str:
    """Return an annotation as text; bounds of nested `Annotated` types are appended to `bounds`."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        inner = [entry for entry in arguments[1:] if isinstance(entry, Array)]
        if inner:
            return f"{inner[0].dtype} [{', '.join(map(str, inner[0].shape))}]"
        bounds += [text for text in _bounds(arguments[1:]) if text not in bounds]
        return _annotation(arguments[0], bounds)
    if origin is Literal:
        return " | ".join(map(_toml, arguments))
    if origin in (Union, UnionType):
        return " | ".join(_annotation(argument, bounds) for argument in arguments)
    if arguments:
        inside = ", ".join("..." if a is Ellipsis else _annotation(a, bounds) for a in arguments)
        return f"{origin.__name__}[{inside}]"
    if annotation is SecretStr:
        return "str"
    if annotation is type(None):
        return "none"
    return getattr(annotation, "__name__", str(annotation))


def _bounds(metadata: Any) -> list[str]:
    found = []
    for entry in metadata:
        for inner in (entry, *getattr(entry, "metadata", ())):  # a FieldInfo holds them in its metadata
            for attribute, sign in _BOUNDS.items():
                limit = getattr(inner, attribute, None)
                if isinstance(limit, int | float) and limit is not PydanticUndefined and abs(limit) < 2**60:
                    text = f"{sign} {limit:g}" if limit < 1e6 else f"{sign} {limit:_}".replace("_", " ")
                    if text not in found:
                        found.append(text)
    return found


def comments_of(cls: type) -> dict[str, str]:
    """Return {field: its comment in the source}: behind the field, or in the lines above it."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not base.__module__.startswith("beamsplat."):
            continue
        lines = textwrap.dedent(inspect.getsource(base)).splitlines()
        for node in ast.parse("\n".join(lines)).body[0].body:  # type: ignore[attr-defined]
            if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
                continue
            inside = [_comment(line) for line in lines[node.lineno - 1 : node.end_lineno]]
            above: list[str] = []
            first = node.lineno - 2
            while first > 0 and lines[first].strip().startswith("#"):
                above.insert(0, _comment(lines[first]))
                first -= 1
            text = " ".join(filter(None, (*above, *inside)))
            if text and not text.startswith("---"):
                found[node.target.id] = text
    return found


def _comment(line: str) -> str:
    """Return the comment of a line of source, "" without one; a `#` inside quotes is not a comment."""
    match = re.match(r"""^(?:[^#"']|"[^"]*"|'[^']*')*#\s*(?P<text>.*)$""", line)
    text = match["text"].strip() if match else ""
    return "" if text.startswith(("noqa", "type:", "fmt:")) else text


def _docstring(cls: type) -> list[str]:
    text = inspect.cleandoc(cls.__doc__ or "")
    return [text, ""] if text else []


def _cell(text: str) -> str:
    """Return text for a cell of a table: `|` is escaped, except in code."""
    parts = text.split("`")
    return "`".join(part if i % 2 else part.replace("|", "\\|") for i, part in enumerate(parts))
