"""Pages made from the code: what commands say of themselves, and the reference of all public names.

Directives: `commands` (help texts, in Markdown pages), `public-names` and `wing-modules` (in
reStructuredText, which autodoc writes).
"""

import ast
import contextlib
import dataclasses
import functools
import importlib
import inspect
import io
import os
import re
import textwrap
from pathlib import Path
from unittest import mock

import tyro
from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx

import gnnjax

PACKAGE = Path(gnnjax.__file__).parent


def command_names() -> list[str]:
    """Modules that are commands, in the order of the alphabet."""
    files = sorted(PACKAGE.glob("*.py"))
    reads = re.compile(r"parse_arguments\(\w+Config\b")
    return [file.stem for file in files if reads.search(file.read_text(encoding="utf-8"))]


def help_of(command: str) -> str:
    """What `python -m gnnjax.<command> --help` prints, an option a line."""
    module = importlib.import_module(f"gnnjax.{command}")
    calls = ast.walk(ast.parse(inspect.getsource(module)))
    (config,) = {
        ast.unparse(call.args[0])
        for call in calls
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "parse_arguments"
    }
    printed = io.StringIO()
    with (
        mock.patch.dict(os.environ, COLUMNS="4000"),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        tyro.cli(getattr(module, config), prog=f"python -m gnnjax.{command}", args=["--help"])
    return printed.getvalue()


def options_of(text: str) -> tuple[str, list[tuple[str, str]]]:
    """What a help text says of the command, and its options: how each is written, what it does."""
    about, *boxes = re.split(r"\n [^\n]*\n -{9,} *\n", text)
    options = []
    # Some boxes begin with a word on their options, above a rule.
    boxes = [re.split(r"^  -{9,} *$", box, flags=re.MULTILINE)[-1] for box in boxes]
    for line in "\n".join(boxes).splitlines():
        if re.match(r"  \S", line):  # what is said goes on farther to the right
            options.append(list(line.strip().partition("  ")[::2]))
        elif options:
            options[-1][1] += " " + line.strip()
    return about.split("\n\n")[1].strip(), [(written, said.strip()) for written, said in options]


class Commands(Directive):
    """A section for each command, with its options."""

    def run(self) -> list[nodes.Node]:
        sections = []
        for command in command_names():
            about, options = options_of(help_of(command))
            name = f"gnnjax.{command}"
            section = nodes.section(ids=[f"gnnjax-{command.replace('_', '-')}"], names=[name])
            section += [nodes.title(text=name), nodes.paragraph(text=about)]
            listed = nodes.definition_list()
            for written, said in options:
                term = nodes.term("", "", nodes.literal(text=written))
                listed += nodes.definition_list_item(
                    "", term, nodes.definition("", nodes.paragraph(text=said))
                )
            section += listed
            self.state.document.note_implicit_target(section)
            sections.append(section)
        return sections


class PublicNames(Directive):
    """All that `import gnnjax` brings, in the order of its table of contents, wing by wing."""

    def run(self) -> list[nodes.Node]:
        wings: dict[str, list[str]] = {}
        tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gnnjax."):
                wing = (node.module or "").split(".")[1]
                wings.setdefault(wing, []).extend(alias.name for alias in node.names)
        lines = []
        for wing, names in wings.items():
            lines += [wing, "-" * len(wing), "", *_summary(f"gnnjax.{wing}"), ""]
            for name in names:
                thing = getattr(gnnjax, name)
                lines += [f".. auto{_kind(thing)}:: gnnjax.{name}", *_members(thing), ""]
        return _parsed(self, lines)


class WingModules(Directive):
    """All modules of the package, and what they define, a line each."""

    def run(self) -> list[nodes.Node]:
        wings: dict[str, list[str]] = {}
        for file in sorted(PACKAGE.rglob("*.py")):
            parts = file.relative_to(PACKAGE).with_suffix("").parts
            if parts[-1] != "__init__":
                wings.setdefault(parts[0] if len(parts) > 1 else "gnnjax", []).append(
                    ".".join(("gnnjax", *parts))
                )
        lines = []
        for wing, modules in wings.items():
            lines += [wing, "-" * len(wing), ""]
            for name in modules:
                module = importlib.import_module(name)
                lines += [f"``{name}``", *(f"   {line}" for line in _summary(name)), ""]
                for member, thing in vars(module).items():
                    if not member.startswith("_") and getattr(thing, "__module__", "") == name:
                        first = (inspect.getdoc(thing) or "").split("\n\n")[0].replace("\n", " ")
                        lines += [f"   - ``{member}``: {first}"]
                lines += [""]
        return _parsed(self, lines)


def _parsed(directive: Directive, lines: list[str]) -> list[nodes.Node]:
    parent = nodes.section()
    parent.document = directive.state.document
    directive.state.nested_parse(
        StringList(lines, source="from_code"), 0, parent, match_titles=True
    )
    return parent.children


def _summary(module: str) -> list[str]:
    doc = inspect.getdoc(importlib.import_module(module)) or ""
    return doc.split("\n\n")[0].splitlines()


def _members(thing: object) -> list[str]:
    """The option of autodoc that names the methods and properties of a class, its fields aside."""
    kinds = (property, functools.cached_property, classmethod, staticmethod)
    names = [
        name
        for name, member in (vars(thing) if inspect.isclass(thing) else {}).items()
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, kinds))
    ]
    documented = [name for name in names if inspect.getdoc(getattr(thing, name))]
    return [f"   :members: {', '.join(documented)}"] if documented else []


def _kind(thing: object) -> str:
    if inspect.isclass(thing):
        return "exception" if issubclass(thing, BaseException) else "class"
    return "function" if callable(thing) else "data"


@functools.cache
def _definition(thing: object) -> ast.AST | None:
    try:
        return ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
    except (OSError, TypeError, SyntaxError):
        return None


def signature(app, what, name, thing, options, arguments, returns):
    """Signatures as they are written, whose annotations hold the shapes: `Float[Array, "N D"]`."""
    made = thing.__init__ if what == "class" else thing
    if what == "class" and (hasattr(thing, "_fields") or dataclasses.is_dataclass(thing)):
        return "", None  # the fields are shown below
    node = _definition(inspect.unwrap(made))
    if not isinstance(node, ast.FunctionDef):
        return None
    given = node.args.posonlyargs or node.args.args
    if what in ("class", "method") and given:
        given.pop(0)  # self
    for constant in ast.walk(node):
        if isinstance(constant, ast.Constant) and isinstance(constant.value, str):
            constant.value = constant.value.strip()  # jaxtyping's " D"
    return f"({ast.unparse(node.args)})", node.returns and ast.unparse(node.returns)


def fields(app, what, name, thing, options, lines):
    """Fields of tuples and dataclasses, as they stand in the code, with their comments."""
    node = _definition(thing) if what == "class" else None
    if not isinstance(node, ast.ClassDef):
        return
    stated = [each for each in node.body if isinstance(each, ast.AnnAssign)]
    if not stated:
        return
    source = textwrap.dedent(inspect.getsource(thing)).splitlines()
    first = stated[0].lineno - 1
    while source[first - 1].strip().startswith("#"):
        first -= 1
    after = [
        each.lineno - len(getattr(each, "decorator_list", []))
        for each in node.body
        if isinstance(each, ast.FunctionDef)
    ]
    last = min(after, default=len(source) + 1) - 1
    block = textwrap.dedent("\n".join(source[first:last])).strip()
    lines += ["", ".. code-block:: python", "", *textwrap.indent(block, "   ").splitlines(), ""]


def complete(app, page, content):
    """Pages that the index does not name come last in its first table of contents."""
    if page == app.config.root_doc:
        named = set(content[0].split("\n"))
        pages = {file.stem for file in Path(app.srcdir).glob("*.md")} - {page}
        before, end, after = content[0].partition("\n```\n")
        content[0] = "\n".join([before, *sorted(pages - named)]) + end + after


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("commands", Commands)
    app.add_directive("public-names", PublicNames)
    app.add_directive("wing-modules", WingModules)
    app.connect("source-read", complete)
    app.connect("autodoc-process-signature", signature)
    app.connect("autodoc-process-docstring", fields)
    return {"parallel_read_safe": True}
