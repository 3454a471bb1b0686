"""Which machine a shared library is made for, read from its first bytes without loading it."""

from __future__ import annotations

import struct
from pathlib import Path

_ELF = {3: "x86", 62: "x86_64", 40: "arm", 183: "aarch64", 243: "riscv"}
_PE = {0x14C: "x86", 0x8664: "x86_64", 0x1C0: "arm", 0xAA64: "aarch64"}
_MACH = {7: "x86", 0x1000007: "x86_64", 12: "arm", 0x100000C: "aarch64"}
_PLATFORMS = {
    "linux64": ("linux", "x86_64"),
    "aarch64-linux": ("linux", "aarch64"),
    "win64": ("windows", "x86_64"),
    "darwin64": ("darwin", "x86_64"),
    "aarch64-darwin": ("darwin", "aarch64"),
}


def misfit(library: Path, platform: str) -> str:
    """What keeps a library from being loaded on a platform of fmus.toolchain.PLATFORMS; empty where nothing is seen.

    The system's loader has the last word: it also looks for the libraries that this one wants.
    """
    wanted = _PLATFORMS.get(platform)
    with library.open("rb") as file:
        head = file.read(4096)
    if not head:
        return f"its binary {_shown(library)} is empty"
    made = _made_for(head)
    if wanted is None:
        return ""
    if made is None:
        return f"its binary {_shown(library)} is no shared library: it begins with {head[:4].hex(' ')}"
    system, bits, machines = made
    if system == wanted[0] and wanted[1] in machines:
        return f"its binary {_shown(library)} is cut short" if _elf_end(head) > library.stat().st_size else ""
    return f"its binary {_shown(library)} is {bits}-bit for {system} on {', '.join(machines)}, not for {platform}"


def _shown(library: Path) -> str:
    return "/".join(library.parts[-3:])


def _made_for(head: bytes) -> tuple[str, int, list[str]] | None:
    """System, bits and machines of a library that begins so; None where its kind is not known."""
    if head[:4] == b"\x7fELF" and len(head) >= 20:
        order = ">" if head[5] == 2 else "<"
        (machine,) = struct.unpack_from(f"{order}H", head, 18)
        return "linux", 32 if head[4] == 1 else 64, [_ELF.get(machine, f"machine {machine}")]
    if head[:2] == b"MZ" and len(head) >= 64:
        (offset,) = struct.unpack_from("<I", head, 60)
        if head[offset : offset + 4] != b"PE\0\0" or len(head) < offset + 6:
            return None
        (machine,) = struct.unpack_from("<H", head, offset + 4)
        return "windows", 32 if machine in (0x14C, 0x1C0) else 64, [_PE.get(machine, f"machine {machine}")]
    if head[:4] in (b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe") and len(head) >= 8:
        (machine,) = struct.unpack_from("<I", head, 4)
        return "darwin", 64 if head[0] == 0xCF else 32, [_MACH.get(machine, f"machine {machine}")]
    if head[:4] == b"\xca\xfe\xba\xbe" and len(head) >= 8:
        (count,) = struct.unpack_from(">I", head, 4)
        places = range(8, min(8 + 20 * count, len(head) - 3), 20)
        machines = [struct.unpack_from(">I", head, place)[0] for place in places]
        return "darwin", 64, [_MACH.get(machine, f"machine {machine}") for machine in machines]
    return None


def _elf_end(head: bytes) -> int:
    """How many bytes the segments of a 64-bit ELF library reach to, as far as its head tells; 0 for other files."""
    if head[:6] != b"\x7fELF\x02\x01" or len(head) < 64:
        return 0
    (table,) = struct.unpack_from("<Q", head, 32)
    size, count = struct.unpack_from("<HH", head, 54)
    places = (table + size * index for index in range(count))
    segments = (struct.unpack_from("<IIQQQQ", head, place) for place in places if place + 40 <= len(head))
    return max((offset + length for _, _, offset, _, _, length in segments), default=0)
