"""Triton's interpreter runs kernels on the CPU. It must be chosen before Triton is imported, so the tests that use it
run in processes of their own, which ``test_triton.py`` starts."""

from __future__ import annotations

import os

INTERPRETING = os.environ.get("TRITON_INTERPRET") == "1"

collect_ignore = [] if INTERPRETING else ["test_triton_interpreted.py"]


def _patch_once() -> None:
    """Let the interpreter patch Triton's language once for each module, instead of at every call of a function.

    That is most of its time; the patches of calls within a kernel are never taken back anyway.
    """
    from triton.runtime import interpreter

    original, seen = interpreter._patch_lang, set()

    def patch(function):  # type: ignore[no-untyped-def]
        if function.__module__ not in seen:
            seen.add(function.__module__)
            original(function)
        return interpreter._LangPatchScope()

    interpreter._patch_lang = patch


if INTERPRETING:
    _patch_once()
