"""The house rules, checked on the source itself."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "bayes_nlsid"
MODULES = sorted(PACKAGE.rglob("*.py"))
ALLOWED = {
    "emcee": re.compile(r"inference/ensemble\.py"),
    "arviz": re.compile(r"inference/arviz_export\.py"),
    "matplotlib": re.compile(r"study/figures(_\w+)?\.py"),
    "numba": re.compile(r"(forces|simulation)/compiled\.py|simulation/vector\.py"),
}
LINES = 420
BODY = 70


@cache
def rooms() -> list[str]:
    """The order of the rooms, from the table in the documentation."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| `([a-z]+)/?` \|", text, flags=re.MULTILINE)
    assert found[0] == "symlog" and found[-1] == "cli", found
    return ["errors", *found]


def relative(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def room_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0].removesuffix(".py")


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    """Everything in the syntax tree of a file."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))))


@cache
def imports(path: Path) -> frozenset[str]:
    """Every module that a file imports, anywhere in it, with relative imports spelled out."""
    package = ["bayes_nlsid", *path.relative_to(PACKAGE).parts[:-1]]
    out: set[str] = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            out |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            out |= {module} | ({f"{module}.{a.name}" for a in node.names} if module == "bayes_nlsid" else set())
    return frozenset(out)


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_imports_point_to_earlier_rooms(path: Path) -> None:
    order = rooms()
    own = room_of(path)
    if own in ("__init__", "__main__"):
        return
    assert own in order, f"{own} is not in the table of rooms in docs/architecture.md"
    allowed = set(order[:order.index(own) + 1])
    for module in imports(path):
        parts = module.split(".")
        if parts[0] == "bayes_nlsid" and len(parts) > 1 and parts[1] != "__version__":
            assert parts[1] in allowed, f"{relative(path)} imports {module}, which stands below it"


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_heavy_packages_stand_where_they_may(path: Path) -> None:
    tops = {module.split(".")[0] for module in imports(path)}
    for name, where in ALLOWED.items():
        if name in tops:
            assert where.fullmatch(relative(path)), f"{name} is imported in {relative(path)}"


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_nothing_prints_and_nothing_is_a_drawer(path: Path) -> None:
    assert path.stem not in ("utils", "util", "common", "helpers", "misc")
    if relative(path) == "cli.py":
        return
    calls = [n.lineno for n in nodes_of(path) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name) and n.func.id == "print"]
    assert not calls, f"print in lines {calls}"


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_sizes(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= LINES, f"{relative(path)} has {text.count(chr(10))} lines"
    for node in nodes_of(path):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0]
            has_doc = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)
            start = (node.body[1].lineno if len(node.body) > 1 else first.end_lineno or first.lineno) if has_doc else first.lineno
            length = (node.end_lineno or start) - start + 1
            assert length <= BODY, f"{relative(path)}: {node.name} has a body of {length} lines"


def _is_abstract(node: ast.ClassDef) -> bool:
    names = {ast.unparse(base).split(".")[-1].split("[")[0] for base in node.bases} | {ast.unparse(k.value) for k in node.keywords}
    return bool(names & {"ABC", "Protocol", "ABCMeta", "abc.ABCMeta"})


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_every_class_is_final_or_abstract(path: Path) -> None:
    for node in nodes_of(path):
        if isinstance(node, ast.ClassDef):
            decorators = {ast.unparse(d).split("(")[0].split(".")[-1] for d in node.decorator_list}
            assert "final" in decorators or _is_abstract(node), f"{relative(path)}: class {node.name} is neither @final nor abstract"


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_random_numbers_are_explicit(path: Path) -> None:
    """numpy's global generator is hidden state: only Generator, SeedSequence and bit generators are named."""
    for node in nodes_of(path):
        if (isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "random"
                and ast.unparse(node.value) in ("np.random", "numpy.random")):
            assert node.attr in ("Generator", "SeedSequence", "default_rng", "PCG64", "PCG64DXSM", "RandomState", "MT19937"), \
                f"{relative(path)} line {node.lineno}: np.random.{node.attr}"
            if node.attr == "RandomState":
                assert ALLOWED["emcee"].fullmatch(relative(path)), f"{relative(path)}: RandomState is for emcee only"


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_nothing_read_is_ever_executed(path: Path) -> None:
    """No eval, exec or pickle of what a file holds; only workers unpickle, and only what their own parent sent them."""
    for node in nodes_of(path):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in ("eval", "exec", "compile", "__import__", "builtins.eval", "builtins.exec"), f"line {node.lineno}"
            assert not any(k.arg == "allow_pickle" and ast.unparse(k.value) != "False" for k in node.keywords), f"line {node.lineno}"
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module] if isinstance(node, ast.ImportFrom) else []
        unsafe = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "yaml"} & {str(name).partition(".")[0] for name in names}
        assert not unsafe or relative(path) == "executors.py", unsafe


def test_docs_name_every_room() -> None:
    assert {room_of(path) for path in MODULES} - {"__init__", "__main__"} <= set(rooms())


@pytest.mark.parametrize("command", ["import bayes_nlsid", "from bayes_nlsid.cli import main; main(['--help'])"])
def test_starting_is_light(command: str) -> None:
    """Neither the import nor --help may load what takes long to load."""
    code = f"import sys\ntry:\n    exec({command!r})\nexcept SystemExit:\n    pass\nprint(' '.join(sorted(sys.modules)), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT,
                          env={"PYTHONPATH": str(ROOT / "src"), "PATH": "/usr/bin:/bin"})
    loaded = set(done.stderr.split())
    heavy = {"scipy.signal", "scipy.optimize", "matplotlib", "arviz", "emcee", "numba", "pandas", "xarray"}
    assert not loaded & heavy, f"loaded: {sorted(loaded & heavy)}"
