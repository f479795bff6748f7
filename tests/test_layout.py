"""The layers of the package: imports run downwards, without cycles; nothing is printed or asserted."""

import ast
import functools
import graphlib
import importlib
import pathlib
import re

import mcgicp_jax

ROOT = pathlib.Path(mcgicp_jax.__file__).parent
# From the ground up: a folder imports from itself and from the folders before it.
LAYERS = (
    "_compute",
    "_math",
    "_search",
    "_clouds",
    "_local_geometry",
    "_terms",
    "_methods",
    "_pose_solver",
    "_registration",
    "_global_pose",
    "_pairs",
    "_pose_graph",
    "_sequences",
    "guide",
    "metrics",
    "io",
    "datasets",
    "plot",
    "extend",
    "_cli",
    "__main__",
)
MODULES = {name for name in LAYERS if not name.startswith("_")}
RANK = {name: rank for rank, name in enumerate(LAYERS)}


@functools.cache
def files():
    paths = sorted(ROOT.rglob("*.py"))
    parts = [path.relative_to(ROOT).with_suffix("").parts for path in paths]
    return [(*each, ast.parse(each[0].read_text(encoding="utf-8"))) for each in zip(paths, parts, strict=True)]


def imports(parts, tree):
    """Full names of the modules that a file imports, anywhere in it."""
    package = ("mcgicp_jax", *parts)[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join((*start, *filter(None, [node.module])))
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def edges():
    """Which module imports which, for every pair, as paths without the name of the package."""
    modules = {".".join(parts).removesuffix(".__init__") for _, parts, _ in files()}
    for _, parts, tree in files():
        if parts != ("__init__",):
            for name in imports(parts, tree):
                package, _, inner = name.partition(".")
                if package == "mcgicp_jax" and inner in modules:
                    yield ".".join(parts).removesuffix(".__init__"), inner


def test_imports_run_downwards():
    pairs = [(a, b) for a, b in edges() if RANK[b.split(".")[0]] > RANK[a.split(".")[0]]]
    assert not [f"{a} imports {b}" for a, b in pairs]


def test_there_is_no_cycle():
    graph = {}
    for a, b in edges():
        if a != b:
            graph.setdefault(b, set()).add(a)
    list(graphlib.TopologicalSorter(graph).static_order())


def test_nothing_inside_imports_the_package_as_a_whole():
    """That would be an edge to everything. The commands, past all modules, are users like others."""
    users = {
        "/".join(parts)
        for _, parts, tree in files()
        for node in ast.walk(tree)
        if (isinstance(node, ast.Import) and any(alias.name == "mcgicp_jax" for alias in node.names))
        or (isinstance(node, ast.ImportFrom) and node.module == "mcgicp_jax" and {a.name for a in node.names} - MODULES)
    }
    assert not {name for name in users if name.startswith("_") and not name.startswith("_cli/")} - {
        "__init__",
        "__main__",
    }


def test_slow_packages_are_imported_late():
    """Import time: of SciPy, only `scipy.spatial` and what it loads; no package of an extra."""
    allowed = {"scipy.spatial", "scipy.spatial.transform", "scipy.sparse"}
    slow = {"scipy", "matplotlib", "plotly", "PIL", "laspy", "plyfile", "pypcd4", "pykdtree", "cv2", "distributed"}
    early = []
    for _, parts, tree in files():
        statements = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        early += [(parts, name) for name in imports(parts, ast.Module(statements, [])) if name.split(".")[0] in slow]
    assert (("_search", "kd_tree"), "scipy.spatial") in early
    assert not [(parts, name) for parts, name in early if not {name, name.rpartition(".")[0]} & allowed]


def test_nothing_is_printed_or_asserted():
    found = []
    for path, parts, tree in files():
        for node in ast.walk(tree):
            printed = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
            if (printed and parts[0] not in ("__main__", "_cli")) or isinstance(node, ast.Assert):
                found.append(f"{path.name}:{node.lineno}")
    assert not found


def test_benchmarks_can_be_imported():
    """Without the packages that some of them compare with."""
    for path in (pathlib.Path(__file__).parent / "benchmarks").glob("*.py"):
        try:
            importlib.import_module(f"tests.benchmarks.{path.stem}")
        except ModuleNotFoundError as error:
            if error.name is None or error.name.startswith(("tests", "mcgicp_jax")):
                raise


def test_the_index_of_the_package_lists_all_public_names():
    """At the top of `help(mcgicp_jax)`."""
    listed = set(re.findall(r"\w+", mcgicp_jax.__doc__))
    assert set(mcgicp_jax.__all__) <= listed
