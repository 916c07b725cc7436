"""Mitsuba's errors, which span lines and name C++ files, as one line that says what to do."""

from __future__ import annotations

import re

_CPP_LOCATION = re.compile(r"\[\w+\.(?:cpp|h):\d+\] ")

#: What Python puts before the message of an exception that has come through C++.
_PYTHON_TRACEBACK = re.compile(r"^.*?Traceback \(most recent call last\):.*\n\w*Error: ", re.DOTALL)

_FIXES = (
    (re.compile(r"Plugin \"[^\"]*\" not found"), "check its spelling, or pass --integrator NAME"),
    (
        re.compile(r'unreferenced propert.* in integrator plugin of type "(path|volpath|direct)"'),
        r"\1 has no such parameter: pass --integrator envmap_hybrid, or remove it",
    ),
    (re.compile(r"unreferenced propert"), "check the spelling, or remove it"),
    (re.compile(r"undefined parameter: \$(\w+)"), r"pass -D \1=VALUE"),
    (re.compile(r"unused parameters?: - \$(\w+)"), r"the scene has no $\1; remove -D \1"),
    (re.compile(r"wrong type \(expected (\w+)"), r"give it as \1"),
    (re.compile(r"CUDA backend"), "no usable NVIDIA GPU here; pass -m llvm_ad_rgb"),
    (re.compile(r"file not found|does not exist"), "check the path"),
)


def condense(error: BaseException) -> str:
    """The message on one line, without C++ locations, followed by what to do about it if known."""
    text = _CPP_LOCATION.sub("", str(error)) or type(error).__name__
    text = _PYTHON_TRACEBACK.sub("", text)
    text = " ".join(text.split())
    for pattern, fix in _FIXES:
        if match := pattern.search(text):
            return f"{text} ({match.expand(fix)})"
    return text
