"""The layers of the package: imports run downwards, without cycles; nothing is printed or asserted."""

import ast
import graphlib
import pathlib

import mcgicp_jax

ROOT = pathlib.Path(mcgicp_jax.__file__).parent
# From the ground up: a module knows those of its own layer and of the layers below.
LAYERS = {
    "algebra": ("_pose", "_algebra", "_statistics", "_kernels", "_sizes", "_deferred", "_checks"),
    "running": ("_threads", "_blocks"),
    "search": ("_search", "_nearest", "_tree_index", "_pykdtree", "_trees", "_dense"),
    "data": (
        "_cloud",
        "_kept",
        "_preprocess",
        "_spaces",
        "_map",
        "_formats",
        "_initial_poses",
        "_pose_graph",
        "_g2o",
        "io",
        "metrics",
        "datasets",
    ),
    "local surfaces": ("_surface", "_observability", "_neighborhoods", "_local", "_channels", "_features"),
    "correspondences": ("_forces", "_methods", "_surfaces", "_sums", "_gaussians", "_ndt"),
    "pose": ("_solve", "_pose_form", "_fusion", "_hypotheses", "_directions", "_uncertainty", "_result", "_step"),
    "loops": ("_host", "_traced", "_lanes", "_normal_equations", "_sparse_inverse", "_graph_traced"),
    "use": (
        "_options",
        "_cost",
        "_outcome",
        "_tie_points",
        "_register",
        "_global",
        "_image_matches",
        "_channel_covariance",
        "_batch",
        "_graph",
        "_loops",
        "_odometry",
        "_multiway",
    ),
    "faces": ("plot", "_commands", "__main__"),
}
LAYER = {module: rank for rank, modules in enumerate(LAYERS.values()) for module in modules}
MODULES = {path.stem for path in ROOT.iterdir()}


def files():
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        yield path, parts, ast.parse(path.read_text(encoding="utf-8"))


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


def test_the_imports_are_read():
    found = {parts: set(imports(parts, tree)) for _, parts, tree in files()}
    assert {"mcgicp_jax._cloud", "jax.numpy"} <= found[("_methods",)]
    assert set(imports(("datasets", "x"), ast.parse("from ..io import read\nfrom .y import z"))) == {
        *("mcgicp_jax.io", "mcgicp_jax.io.read", "mcgicp_jax.datasets.y", "mcgicp_jax.datasets.y.z")
    }


def test_every_module_has_its_place():
    assert {parts[0] for _, parts, _ in files()} - {"__init__"} == set(LAYER)


def edges():
    """Which module imports which, for every pair."""
    for _, parts, tree in files():
        if parts != ("__init__",):
            for name in imports(parts, tree):
                if name.startswith("mcgicp_jax.") and name.split(".")[1] in LAYER:
                    yield parts[0], name.split(".")[1]


def test_imports_run_downwards():
    assert not [f"{a} imports {b}" for a, b in edges() if LAYER[b] > LAYER[a]]


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
    assert not {name for name in users if name.startswith("_") and not name.startswith("_commands/")} - {"__init__"}


def test_scipy_has_six_doors():
    """Trees, rotations, first poses of graphs, sparse factorisations and products, and MATLAB files of a data set."""
    users = {
        "/".join(parts) for _, parts, tree in files() for name in imports(parts, tree) if name.split(".")[0] == "scipy"
    }
    assert users == {"_trees", "_pose", "_initial_poses", "_normal_equations", "_features", "datasets/_ford"}


def test_nothing_is_printed_or_asserted():
    found = []
    for path, parts, tree in files():
        for node in ast.walk(tree):
            printed = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
            if (printed and parts[0] not in ("__main__", "_commands")) or isinstance(node, ast.Assert):
                found.append(f"{path.name}:{node.lineno}")
    assert not found
