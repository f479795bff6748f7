"""What one registration passes through: Python holds a lock, and each call takes some microseconds."""

import pathlib
import sys

import numpy as np

import mcgicp_jax as mcg
from tests.scenes import pair

PACKAGE = str(pathlib.Path(mcg.__file__).parent)
# Calls of functions of the package, different ones, and those within each other. They may fall, but not rise.
LIMITS = (429, 136, 18)


def passed_through(call):
    """The number of calls of functions of the package, of different ones, and of those within each other."""
    names, deepest, depth = [], 0, 0

    def profile(frame, event, _):
        nonlocal deepest, depth
        # Checks of annotations have other file names.
        if frame.f_code.co_filename.startswith(PACKAGE) and event in ("call", "return"):
            depth += 1 if event == "call" else -1
            deepest = max(deepest, depth)
            if event == "call":
                names.append((frame.f_code.co_filename, frame.f_code.co_name))

    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
    return len(names), len(set(names)), deepest


def test_a_registration_passes_few_functions():
    """Of three updates, by one thread."""
    source, target, _ = pair()
    source, target = (mcg.preprocess(cloud.unpad(), None) for cloud in (source, target))
    options = {"max_distance": 0.5, "max_iterations": 3, "search": mcg.KDTreeSearch(1, "scipy")}
    tolerances = {"translation_tolerance": 1e-12, "rotation_tolerance": 1e-12}

    def register():
        return mcg.register(source, target, mcg.GICP(), **options, **tolerances)

    assert register().num_iterations == 3
    register()
    passed = passed_through(register)
    assert np.all(np.array(passed) <= LIMITS), passed
