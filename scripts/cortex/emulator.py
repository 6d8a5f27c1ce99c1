"""Cycles of a Cortex-M0+: Unicorn runs the code, a table says what each instruction costs.

The table is ARM's (Cortex-M0+ Technical Reference Manual, r0p1, table 3-1), for the core with the
single-cycle multiplier and memory without wait states: code and data in RAM. What a real chip adds
is not in it: the flash's misses, the bus shared with others, the entry into interrupts.
"""

from __future__ import annotations

import bisect
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import unicorn
from tools import PREFIX
from unicorn import arm_const as arm

CODE, RAM, SIZE = 0x00000000, 0x20000000, 1 << 20
RETURN = 0x000F0000  # where a call comes back to: nothing is there


def cost(word: int) -> int:
    """Cycles of a 16-bit instruction; of a conditional branch, where it is not taken."""
    if word >> 12 in (0b0101, 0b0110, 0b0111, 0b1000, 0b1001) or word >> 11 == 0b01001:
        return 2  # loads and stores
    if word >> 12 == 0b1100 or word & 0xFE00 in (0xB400, 0xBC00):  # LDM, STM, PUSH, POP
        registers = (word & 0x1FF if word >> 12 == 0b1011 else word & 0xFF).bit_count()
        return registers + (3 if word & 0xFF00 == 0xBD00 else 1)  # into the program counter
    if word >> 11 == 0b11100 or word & 0xFF00 == 0x4700:  # B, BX, BLX
        return 2
    if word & 0xFF00 in (0x4400, 0x4600) and word & 0x87 == 0x87:  # ADD, MOV to it
        return 2
    return 1


def is_conditional(word: int) -> bool:
    return word >> 12 == 0b1101 and word >> 9 != 0b1101111


def is_wide(word: int) -> bool:
    """The first half of a 32-bit instruction: of this core's, BL, MRS, MSR and barriers, 3 each."""
    return word >> 11 in (0b11101, 0b11110, 0b11111)


@dataclass
class Call:
    """One call of a watched function."""

    name: str
    back: int
    begun: int


@dataclass
class Tally:
    """What ran between two calls of `take`."""

    cycles: int = 0
    packets: int = 0  # that arrived
    calls: dict[str, list[int]] = field(default_factory=dict)  # cycles of each call, all in
    own: dict[str, int] = field(default_factory=dict)  # cycles in each function itself
    # Times that each block ran, by address and size.
    blocks: dict[tuple[int, int], int] = field(default_factory=dict)


class Image:
    """An ELF file's symbols, and its bytes as the memory has them."""

    def __init__(self, file: Path) -> None:
        self.symbols: dict[str, int] = {}
        functions: list[tuple[int, str]] = []
        for line in self._said(file, "nm"):
            if len(line.split()) == 3:
                address, kind, name = line.split()
                name = name.partition(".")[0]  # of a copy with some arguments known
                self.symbols[name] = int(address, 16)
                if kind in "tT":
                    functions.append((int(address, 16) & ~1, name))
        functions.sort()
        self.starts = [start for start, _ in functions]
        self.names = [name for _, name in functions]
        flat = file.with_suffix(".bin")
        for section, base in ((".text", CODE), (".data", RAM)):
            self._said(file, "objcopy", "-O", "binary", "-j", section, str(flat), first=True)
            setattr(self, section[1:], (base, flat.read_bytes()))

    text: tuple[int, bytes]
    data: tuple[int, bytes]

    @staticmethod
    def _said(file: Path, tool: str, *words: str, first: bool = False) -> list[str]:
        words = (*words[:-1], str(file), *words[-1:]) if first else (str(file), *words)
        done = subprocess.run([f"{PREFIX}{tool}", *words], check=True, capture_output=True)
        return done.stdout.decode().splitlines()

    def function(self, address: int) -> str:
        """Of an address in the code."""
        return self.names[bisect.bisect_right(self.starts, address) - 1]


class Emulator:
    """A core with the image in its memory, that counts."""

    def __init__(self, file: Path, watched: tuple[str, ...] = ()) -> None:
        self.image = Image(file)
        self.core = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS)
        self.core.ctl_set_cpu_model(arm.UC_CPU_ARM_CORTEX_M0)
        self.core.mem_map(CODE, SIZE)
        self.core.mem_map(RAM, SIZE)
        for base, content in (self.image.text, self.image.data):
            self.core.mem_write(base, content)
        self.tally = Tally()
        self._watched = {self.image.symbols[name] & ~1: name for name in watched}
        self._calls: list[Call] = []
        self._costs: dict[tuple[int, int], tuple[int, int, str]] = {}
        self._next = (
            -1
        )  # where a conditional branch at the end of the last block leads if not taken
        self.core.hook_add(unicorn.UC_HOOK_BLOCK, self._block)

    def price(self, address: int, size: int) -> list[tuple[int, int]]:
        """Address and cycles of a block's instructions; of a conditional branch, not taken."""
        code = bytes(self.core.mem_read(address, size))
        words = [int.from_bytes(code[i : i + 2], "little") for i in range(0, size, 2)]
        prices, at = [], 0
        while at < len(words):
            wide = is_wide(words[at])
            prices.append((address + 2 * at, 3 if wide else cost(words[at])))
            at += 1 + wide
        return prices

    def _priced(self, address: int, size: int) -> tuple[int, int, str]:
        """Cycles of a block, where it leads if its last branch is not taken (-1: it has none), and
        whose it is."""
        prices = self.price(address, size)
        last = prices[-1][0]
        word = int.from_bytes(self.core.mem_read(last, 2), "little")
        follows = address + size if is_conditional(word) else -1
        return sum(cycles for _, cycles in prices), follows, self.image.function(address)

    def _block(self, core: Any, address: int, size: int, _: Any) -> None:
        tally = self.tally
        if self._next >= 0 and address != self._next:
            tally.cycles += 1
        if self._calls and address == self._calls[-1].back:
            call = self._calls.pop()
            tally.calls.setdefault(call.name, []).append(tally.cycles - call.begun)
        if name := self._watched.get(address):
            back = core.reg_read(arm.UC_ARM_REG_LR) & ~1
            self._calls.append(Call(name, back, tally.cycles))
        if (address, size) not in self._costs:
            self._costs[address, size] = self._priced(address, size)
        cycles, self._next, own = self._costs[address, size]
        tally.cycles += cycles
        tally.own[own] = tally.own.get(own, 0) + cycles
        tally.blocks[address, size] = tally.blocks.get((address, size), 0) + 1

    def call(self, name: str, *arguments: int) -> int:
        """Calls a function of up to four numbers; returns its result, unsigned."""
        registers = (arm.UC_ARM_REG_R0, arm.UC_ARM_REG_R1, arm.UC_ARM_REG_R2, arm.UC_ARM_REG_R3)
        for register, value in zip(registers, arguments, strict=False):
            self.core.reg_write(register, value & 0xFFFFFFFF)
        self.core.reg_write(arm.UC_ARM_REG_SP, RAM + SIZE - 8)
        self.core.reg_write(arm.UC_ARM_REG_LR, RETURN | 1)
        self._next = -1
        self.core.emu_start(self.image.symbols[name] | 1, RETURN)
        if self._next >= 0:  # no function of a compiler's ends so
            raise RuntimeError(f"{name} did not return")
        self._close()
        result: int = self.core.reg_read(registers[0])
        return result

    def _close(self) -> None:
        """Calls that were the last thing the call did."""
        while self._calls:
            call = self._calls.pop()
            cycles = self.tally.cycles - call.begun
            self.tally.calls.setdefault(call.name, []).append(cycles)

    def take(self) -> Tally:
        """What ran since the last time."""
        tally, self.tally = self.tally, Tally()
        return tally

    def address(self, name: str) -> int:
        return self.image.symbols[name]

    def read(self, address: int, size: int) -> bytes:
        return bytes(self.core.mem_read(address, size))

    def read_u32(self, name: str) -> int:
        return int.from_bytes(self.read(self.address(name), 4), "little")

    def write(self, address: int, content: bytes) -> None:
        self.core.mem_write(address, content)
