"""What Python writes in C: lists, strings and comments."""

import re
from collections.abc import Sequence


def braced(items: Sequence[str]) -> str:
    """A list of C, in lines that are not long."""
    lines, last = [], ""
    for item in items:
        if last and len(last) + len(item) > 96:
            lines.append(last.rstrip())
            last = ""
        last += f"{item}, "
    text = "\n  ".join([*lines, last]).rstrip(", ")
    return f"{{{text}}}"


def comment(text: str) -> str:
    """Text in a comment of C, in which nothing ends it."""
    return re.sub(r"[^\w .,:;()\[\]'/^+-]|/(?=[/*])", "_", text, flags=re.ASCII)


def string(text: str) -> str:
    """A string of C: bytes that are no plain letters, and what makes trigraphs, are numbers."""
    plain = (
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"?\\' else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{"".join(plain)}"'
