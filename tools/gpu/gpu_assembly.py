# SPDX-License-Identifier: Apache-2.0
"""Parse NVIDIA's and AMD's assembly into the loops of kernels, and count their instructions by class."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

CLASSES = ("fp32", "integer", "shared", "global", "control", "other", "scalar")
"""Classes of instructions.

- fp32: arithmetic and comparisons of floats.
- integer: arithmetic and comparisons of integers, and moves.
- shared: accesses to shared and private memory. global: accesses to global memory.
- control: branches, barriers, waits.
- other: reciprocals, conversions, votes, special registers.
- scalar: instructions of AMD's scalar unit.
"""


@dataclass(frozen=True)
class Instruction:
    """An instruction.

    target: the label that it may jump to.
    ends: True if the next instruction never follows it.
    source: its line in the kernel's text, 0 if unknown.
    control: NVIDIA's scheduling bits (`gpu_chain.py`), or 0.
    """

    name: str
    kind: str
    target: str = ""
    ends: bool = False
    source: int = 0
    control: int = 0


@dataclass
class Block:
    """A basic block: instructions that run one after the other, and the labels of the first.

    number: its place in the kernel.
    above: numbers of its dominators: the blocks that every path to this block passes, and this block.
    """

    labels: set[str] = field(default_factory=set)
    body: list[Instruction] = field(default_factory=list)
    number: int = 0
    above: frozenset[int] = frozenset()

    @property
    def calls(self) -> bool:
        """True if the block calls a function. Only slow paths of divisions and square roots do so, for numbers that are
        denormal, infinite or nearly so, and for zero operands."""
        return any(each.name.startswith("CALL") and not each.target for each in self.body)


@dataclass
class Loop:
    """A loop: its blocks without those of inner loops, source lines of the jumps back to its head, and inner loops."""

    blocks: list[Block]
    sources: set[int]
    inner: list[Loop] = field(default_factory=list)

    @property
    def counts(self) -> Counter[str]:
        """Number of instructions by class, without inner loops."""
        return Counter(each.kind for block in self.blocks for each in block.body)

    @property
    def size(self) -> int:
        """Number of instructions, without inner loops."""
        return sum(len(block.body) for block in self.blocks)

    def walk(self, depth: int = 0) -> Iterator[tuple[int, Loop]]:
        """This loop and all inner loops, each with its depth."""
        yield depth, self
        for loop in self.inner:
            yield from loop.walk(depth + 1)

    @property
    def tree(self) -> str:
        """The nesting of inner loops as parentheses, such as `(()())`."""
        return f"({''.join(loop.tree for loop in self.inner)})"


def kernel_of(blocks: list[Block]) -> Loop:
    """The whole kernel as a loop that runs once."""
    if not blocks:
        return Loop([], set())
    after = _successors(blocks)
    dominators = _dominators(after)
    reached = [block for block, found in enumerate(dominators) if 0 in found]  # neither called functions nor padding
    bodies: dict[int, set[int]] = {}
    latches: dict[int, set[int]] = {}
    for block in reached:
        for head in after[block]:
            if head in dominators[block]:
                bodies.setdefault(head, {head}).update(_natural(after, head, block))
                latches.setdefault(head, set()).add(block)
    nested = sorted(bodies, key=lambda head: (-len(bodies[head]), head))
    whole = Loop([], set())
    loops = {head: Loop([], {blocks[latch].body[-1].source for latch in latches[head]}) for head in nested}
    for place, head in enumerate(nested):
        outer = next((each for each in reversed(nested[:place]) if head in bodies[each]), None)
        (whole if outer is None else loops[outer]).inner.append(loops[head])
    for number, each in enumerate(blocks):
        each.number, each.above = number, frozenset(dominators[number])
        inmost = next((head for head in reversed(nested) if number in bodies[head]), None)
        if number in reached:
            (whole if inmost is None else loops[inmost]).blocks.append(each)
    return whole


def _successors(blocks: list[Block]) -> list[list[int]]:
    place = {label: number for number, block in enumerate(blocks) for label in block.labels}
    after: list[list[int]] = []
    for number, block in enumerate(blocks):
        last = block.body[-1] if block.body else None
        following = [number + 1] if (last is None or not last.ends) and number + 1 < len(blocks) else []
        if last is not None and last.target in place:
            following.append(place[last.target])
        after.append(following)
    return after


def _predecessors(after: list[list[int]]) -> list[list[int]]:
    before: list[list[int]] = [[] for _ in after]
    for block, following in enumerate(after):
        for each in following:
            before[each].append(block)
    return before


def _dominators(after: list[list[int]]) -> list[set[int]]:
    """For each block its dominators: the blocks on every path from the first block. Unreachable blocks have only
    themselves. after: successors of each block."""
    before = _predecessors(after)
    reached, waiting = {0}, [0]
    while waiting:
        fresh = [each for each in after[waiting.pop()] if each not in reached]
        reached.update(fresh)
        waiting += fresh
    found = [set(reached) if block in reached else {block} for block in range(len(after))]
    found[0] = {0}
    changed = True
    while changed:
        changed = False
        for block in sorted(reached - {0}):
            ways = [found[each] for each in before[block] if each in reached]
            common = set.intersection(*ways) | {block}
            changed |= common != found[block]
            found[block] = common
    return found


def _natural(after: list[list[int]], head: int, latch: int) -> set[int]:
    """The blocks of a loop: those that reach the latch without passing the head. after: successors of each block."""
    before = _predecessors(after)
    body, waiting = {head, latch}, [latch]
    while waiting:
        block = waiting.pop()
        fresh = [each for each in before[block] if each not in body] if block != head else []
        body.update(fresh)
        waiting += fresh
    return body


def blocks_of(items: Iterable[str | Instruction]) -> list[Block]:
    """Split labels and instructions into basic blocks."""
    blocks = [Block()]
    for item in items:
        last = blocks[-1]
        if isinstance(item, str):
            if last.body:
                blocks.append(last := Block())
            last.labels.add(item)
            continue
        if last.body and (last.body[-1].target or last.body[-1].ends):
            blocks.append(last := Block())
        last.body.append(item)
    return [block for block in blocks if block.body or block.labels]


_SASS_INTEGER = (
    r"U?(I(ADD|MAD|SETP|MNMX|ABS|SCADD|MUL|NEG|CMP|SET)|LOP|PLOP|SHF|SHL|SHR|LEA|SEL|PRMT|MOV|BMSK|BREV|FLO|POPC|SGXT"
    r"|P2R|R2P|VIADD|VIMNMX|BFE|BFI|CSEL|R2UR)"
)
SASS_KINDS = (
    ("other", r"FCHK|F2|I2|MUFU|FRND"),
    ("fp32", r"F(ADD|MUL|FMA|MNMX|SEL|SET|SETP|CMP)"),
    ("shared", r"LDS|STS|ATOMS|LDL|STL"),
    ("global", r"(LDG|STG|ATOMG?|RED|LD|ST|CCTL|ERRBAR|MEMBAR|FENCE)(\.|$)"),
    ("control", r"BRA|BRX|BSSY|BSYNC|BREAK|BMOV|BAR|CALL|RET|EXIT|JMP|WARPSYNC|YIELD|DEPBAR|NANOSLEEP|KILL"),
    ("integer", _SASS_INTEGER),
)
"""Class of a SASS instruction: that of the first pattern with which its name begins, else `other`."""

GCN_KINDS = (
    (
        "control",
        r"s_(c?branch|endpgm|barrier|wait|nop|delay_alu|sleep|setprio|inst_pref|set_inst|clause|swappc|setpc|trap)",
    ),
    ("shared", r"ds_|scratch_|buffer_"),
    ("global", r"global_|flat_|s_load|s_buffer_load"),
    ("scalar", r"s_"),
    ("other", r"v_(rcp|rsq|sqrt|exp|log|sin|cos|cvt|div_|frexp|ldexp|read|perml|trunc|rndne|floor|ceil|fract)"),
    ("fp32", r"v_(dual_|pk_)?\w*f32"),
    ("integer", r"v_"),
)
"""Class of an AMD instruction. An instruction that does two operations at once counts as one."""


def _classifier(kinds: tuple[tuple[str, str], ...]) -> Callable[[str], str]:
    patterns = [(kind, re.compile(pattern)) for kind, pattern in kinds]
    return lambda name: next((kind for kind, pattern in patterns if pattern.match(name)), "other")


sass_kind, gcn_kind = _classifier(SASS_KINDS), _classifier(GCN_KINDS)

_SASS_LINE = re.compile(
    r"^\s+/\*[0-9a-f]+\*/\s+(?P<guard>@!?\w+\s+)?(?P<name>[A-Z][\w.]*)(?P<rest>[^;]*);(\s*/\*(?P<upper>0x[0-9a-f]+))?"
)
_SASS_WORDS = re.compile(r"/\* 0x[0-9a-f]{16} \*/\s*/\* (0x[0-9a-f]{16}) \*/")
_SASS_LABEL = re.compile(r"^(\.[\w$]+):")
_SASS_SOURCE = re.compile(r'^\s*//## File "[^"]*", line (\d+)')
_SECTION = re.compile(r"^\.text\.([\w$]+):")
_GCN_LINE = re.compile(r"^\s+(?P<name>[a-z][a-z0-9]*_\w+)(?P<rest>[^;]*)")
_GCN_LABEL = re.compile(r"^(\.LBB\w+|\w+):")
_GCN_SOURCE = re.compile(r"^\s+\.loc\s+\d+\s+(\d+)")


def parse_sass(text: str) -> dict[str, Loop]:
    """Kernels by name, from the output of `nvdisasm -c -g -hex`: with source lines and scheduling bits."""
    text = _SASS_WORDS.sub(r"/*\1*/", text)  # an instruction's upper word has the scheduling bits
    return _parsed(text, (_SECTION, _SASS_SOURCE, _SASS_LABEL, _SASS_LINE), _sass)


def parse_gcn(text: str) -> dict[str, Loop]:
    """Kernels by name, from the assembly that clang writes for AMD."""
    names = re.findall(r"^\s+\.amdhsa_kernel (\w+)", text, flags=re.MULTILINE)
    # The end of a function counts as the beginning of another one, which has no instructions.
    begins = re.compile(rf"^({'|'.join(names)}|\.Lfunc_end\d+):")
    kernels = _parsed(text, (begins, _GCN_SOURCE, _GCN_LABEL, _GCN_LINE), _gcn)
    return {name: kernels[name] for name in names}


def _parsed(
    text: str,
    patterns: tuple[re.Pattern[str], re.Pattern[str], re.Pattern[str], re.Pattern[str]],
    instruction: Callable[[re.Match[str], int], Instruction],
) -> dict[str, Loop]:
    """Functions by name.

    patterns: match lines that begin a function, name a source line, or are labels or instructions; the first match
        counts.
    instruction: makes an instruction from a match and the number of its source line.
    """
    begins, names_source, label, line = patterns
    functions: dict[str, list[str | Instruction]] = {}
    current: list[str | Instruction] = []
    source = 0
    for each in text.splitlines():
        if match := begins.match(each):
            current, source = functions.setdefault(match[1], []), 0
        elif match := names_source.match(each):
            source = int(match[1])
        elif match := label.match(each):
            current.append(match[1])
        elif (match := line.match(each)) and match["name"] != "NOP":  # NOPs are padding after NVIDIA's last instruction
            current.append(instruction(match, source))
    return {name: kernel_of(blocks_of(items)) for name, items in functions.items()}


def _sass(match: re.Match[str], source: int) -> Instruction:
    """The instruction of a line of SASS. source: its line in the kernel's text.

    BSSY is no jump: it names the place where paths meet again. CALL is a jump if its target is a label of the kernel
    rather than a function's name.
    """
    name, rest = match["name"], match["rest"]
    family = name.partition(".")[0]
    target = re.search(r"`\((\.[\w$]+)\)", rest) if family in ("BRA", "BRX", "JMP", "CALL") else None
    always = not match["guard"] and not re.match(r"\s*!?U?P[0-6]", rest)
    ends = always and (family in ("BRA", "BRX", "JMP", "EXIT", "RET") or target is not None)
    control = {"control": int(match["upper"], 16) >> 41} if match["upper"] else {}
    return Instruction(name, sass_kind(name), target[1] if target else "", ends, source, **control)


def _gcn(match: re.Match[str], source: int) -> Instruction:
    name, target = match["name"], re.match(r"\s+(\.L\w+)", match["rest"])
    jumps = name.startswith(("s_branch", "s_cbranch"))
    ends = name in ("s_branch", "s_endpgm", "s_setpc_b64")
    return Instruction(name, gcn_kind(name), target[1] if jumps and target else "", ends, source)
