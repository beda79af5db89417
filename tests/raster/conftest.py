"""Triton's interpreter, which runs kernels on the CPU.

It must be chosen before Triton is imported. So the tests that use it run in separate processes,
which ``test_triton.py`` starts.
"""

import os
import re

INTERPRETING = os.environ.get("TRITON_INTERPRET") == "1"


def interpreter_fault(triton, numpy):
    """Why this Triton's interpreter fails with this NumPy; None if it works."""
    versions = [
        tuple(int(number) for number in re.findall(r"\d+", text)[:2]) for text in (triton, numpy)
    ]
    if versions[0] < (3, 7) and versions[1] >= (2, 4):
        return (
            f"the interpreter of Triton {triton} fails with NumPy {numpy}: it needs Triton 3.7 "
            "or NumPy below 2.4"
        )
    return None


collect_ignore = [] if INTERPRETING else ["test_triton_interpreted.py"]


def _patch_once():
    """Let the interpreter patch Triton's language once for each module.

    It would patch it at every call of a function, which takes most of its time. The patches made by
    calls within a kernel are never undone anyway.
    """
    from triton.runtime import interpreter

    original, seen = interpreter._patch_lang, set()
    no_patches = getattr(interpreter, "_LangPatchScope", None)  # since Triton 3.6

    def patch(function):
        if function.__module__ not in seen:
            seen.add(function.__module__)
            original(function)
        return no_patches() if no_patches else None

    interpreter._patch_lang = patch


if INTERPRETING:
    _patch_once()
