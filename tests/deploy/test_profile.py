"""What an export costs: counted twice alike, adding up, within the limits, and each claim able to fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.errors import BadInput, ProgramError, ToolError
from plushsense.deploy.code import TOY_BYTES, read_facts
from plushsense.deploy.profile import Core, Cost, Estimate, _stack_usage, cores, count, estimate, profile
from plushsense.deploy.targets import TARGETS
from plushsense.models.arch import Arch
from support.exports import bundle_of, exported

COUNTING = [name for name, target in TARGETS.items() if target.counts]
Here = Callable[[str], str]


@pytest.mark.parametrize("target", COUNTING)
@pytest.mark.exhaustive_for("cortex-m0", "cortex-m33", "cortex-m4", "riscv32")
def test_counts(target: str, small: Path, target_here: Here) -> None:
    facts = read_facts(small)
    before = {p: p.read_bytes() for p in small.rglob("*") if p.is_file()}
    cost = count(small, target_here(target), facts)
    assert count(small, target, facts) == cost
    assert {p: p.read_bytes() for p in small.rglob("*") if p.is_file()} == before
    assert cost.step is not None and cost.even is not None and cost.step_most is not None and cost.gap is not None
    assert sum(cost.stages.values()) == cost.step
    assert all(part > 0 for name, part in cost.stages.items() if name != "gate") and cost.stages["gate"] == 0
    # Jitter costs interpolation; a step of it may hold one sample more; a gap of 100 ms makes up for two steps
    # but reads one frame only.
    assert cost.even < cost.step < cost.step_most < 1.3 * cost.step
    assert 1.6 * cost.step < cost.gap < 2.2 * cost.step
    assert cost.call_most is not None and cost.call_bound is not None
    assert cost.gap <= cost.call_most <= cost.call_bound < 1.6 * cost.call_most
    assert cost.sections["plush_model"]["rodata"] == facts.model_bytes
    assert cost.flash_bytes > facts.model_bytes + 2000
    code = cost.sections["plushsense"]
    assert 3_000 < code["others"] < code["text"] - 4_000, "plush_begin and its like, and what plush_push runs"
    assert 0 <= TOY_BYTES - cost.toy_bytes <= 24 and cost.memory_bytes == facts.memory_bytes
    assert cost.ram_bytes == cost.toy_bytes + cost.memory_bytes
    assert cost.stack_push is not None
    assert cost.stack_functions["plush_push"] < cost.stack_push < sum(cost.stack_functions.values()) + 64
    assert cost.stack_memory_bytes is not None
    # A toy on its stack, or what the checksum needs; never both.
    assert TOY_BYTES - 24 <= cost.stack_functions["bytes_needed"] <= cost.stack_memory_bytes < 1000
    assert cost.stack_begin is not None and cost.stack_begin < 1000
    assert "memset" in cost.needs and not cost.heap and not cost.floats and not cost.masking


@pytest.mark.exhaustive
def test_a_larger_network_costs_more_only_where_it_is_larger(small: Path, tmp_path: Path, target_here: Here) -> None:
    target = target_here("riscv32")
    large = exported(tmp_path / "large", bundle_of("plush-15", filters="4,12"))
    one, two = (count(folder, target, read_facts(folder)).stages for folder in (small, large))
    assert abs(one["inputs"] - two["inputs"]) < 20
    assert one["network"] * 1.15 < two["network"] < one["network"] * 2
    assert one["dense"] * 1.5 < two["dense"] < one["dense"] * 2.5


@pytest.mark.parametrize(
    ("symbol", "limits"),
    [
        ("14d1_39d2_41d4", {"xtensa": (180_000, 28), "cortex-m4": (90_000, 26)}),
        (
            "14d1_19d2_19d4",
            # 2.8, 1.35, 3.0 and 2.8 for each multiply-accumulate
            {"xtensa": (93_856, 22), "cortex-m4": (45_252, 22), "cortex-m0": (100_560, 22), "riscv32": (93_856, 22)},
        ),
        ("v14_17d2_19d4", {"xtensa": (185_000, 26), "cortex-m4": (85_000, 24)}),
    ],
)
@pytest.mark.exhaustive_for("14d1_19d2_19d4-limits1", "14d1_39d2_41d4-limits0")
def test_the_networks_of_the_issue_stay_within_their_limits(
    symbol: str, limits: dict[str, tuple[int, int]], tmp_path: Path, target_here: Here
) -> None:
    """Instructions of the network, and KiB of flash."""
    layout, filters = ("accel-3", "6,16,16") if symbol.startswith("v") else ("plush-15", "8,12,16")
    folder = exported(tmp_path / "out", bundle_of(layout, symbol, filters))
    found = profile(folder, [target_here(name) for name in limits])
    for name, (limit, flash) in limits.items():
        cost = found.costs[name]
        assert cost.stages["network"] <= limit
        assert cost.flash_bytes <= flash * 1024
        assert cost.ram_bytes + (cost.stack_push or 0) <= 6 * 1024
        assert cost.call_most and cost.call_bound and cost.call_most <= cost.call_bound < 1.3 * cost.call_most
        assert cost.begin is not None
        # A millisecond at 160 MHz, once: most of it is the CRC of the image, by a table of 64 bytes.
        assert cost.begin < 160_000 or symbol != "14d1_19d2_19d4"
    assert all(e.fits == "yes" for e in found.estimates.values())


@pytest.mark.parametrize(("target", "optimise", "most"), [("cortex-m0", "-Os", 1.65), ("xtensa", "-Og", 1.75)])
def test_a_build_for_size_or_for_debugging_is_not_far_slower(
    target: str, optimise: str, most: float, small: Path, target_here: Here
) -> None:
    """The Arduino IDE compiles for size, and ESP-IDF projects for debugging, unless somebody chooses otherwise."""
    facts = read_facts(small)
    slow, fast = (count(small, target_here(target), facts, o).stages["network"] for o in (optimise, "-O2"))
    assert fast <= slow < most * fast


def test_a_heap_and_floating_point_are_found(own: Path, target_here: Here) -> None:
    target = target_here("xtensa")
    source = own / "plushsense.c"
    source.write_text(
        source.read_text()
        + "\nvoid *malloc(size_t n);\nvoid *plush_more(void);\nvoid *plush_more(void) { return malloc(8); }\n"
        "float plush_float(float a, float b);\nfloat plush_float(float a, float b) { return a * b; }\n"
        'void plush_mask(void);\nvoid plush_mask(void) { __asm__ volatile("rsil a2, 15" ::: "a2"); }\n'
    )
    cost = count(own, target, read_facts(own))
    assert cost.heap == ("malloc",)
    assert cost.floats == ("__mulsf3",)
    assert cost.masking == ("rsil",)


@pytest.mark.exhaustive
def test_what_is_counted_is_what_stands_in_the_folder(own: Path, small: Path, target_here: Here) -> None:
    target = target_here("riscv32")
    source = own / "plushsense.c"
    text = source.read_text()
    slower = text.replace("static void dense(plush_toy *toy)\n{", "static void dense(plush_toy *toy)\n{\n    SLOWER")
    assert slower != text
    wait = "#define SLOWER { volatile int i; for (i = 0; i < 1000; i++) { } }\n"
    source.write_text(wait + slower)
    one, two = (count(folder, target, read_facts(folder)) for folder in (small, own))
    assert two.stages["dense"] - one.stages["dense"] > 3000
    assert two.stages["network"] == one.stages["network"]


def test_a_folder_that_does_not_work_is_refused(own: Path, target_here: Here) -> None:
    target = target_here("riscv32")
    model = own / "plush_model.c"
    text = model.read_text()
    cut = text.rindex("128,")
    model.write_text(text[:cut] + "129," + text[cut + 4 :])
    with pytest.raises(BadInput, match=r"plush_model\.c .* --trust"):
        profile(own, [target])
    with pytest.raises(ProgramError, match="refuses its own model on riscv32: export the model again"):
        profile(own, [target], trust=True)
    (own / "golden" / "frames.bin").unlink()
    with pytest.raises(BadInput, match=r"frames\.bin"):
        profile(own, [target])
    model.unlink()
    with pytest.raises(BadInput, match=r"lacks plush_model\.c: export the model again"):
        profile(own, [target])


def test_sizes_on_the_host_without_counts(small: Path, target_here: Here) -> None:
    found = profile(small, [target_here("host")])
    table = found.to_json()
    assert table["instructions_per_step"] == {} and table["estimated_ms"] == {}
    assert found.costs["host"].flash_bytes > 0 and found.costs["host"].step is None


def test_stack_that_the_compiler_does_not_know_is_refused(tmp_path: Path) -> None:
    report = tmp_path / "plushsense.su"
    report.write_text("a.c:1:1:pushes\t48\tdynamic,bounded\na.c:9:1:plain\t64\tstatic\n")
    assert _stack_usage(report) == {"plain": 64, "pushes": 48}
    report.write_text("a.c:1:1:endless\t48\tdynamic\n")
    with pytest.raises(BadInput, match=r"The stack of a.c:1:1:endless is not known"):
        _stack_usage(report)


def test_nothing_to_count_on(small: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ToolError, match="No emulator to count on is installed here: install Debian's gcc-xtensa-lx106"):
        profile(small)
    with pytest.raises(ToolError, match="cortex-m4 .* install Debian's gcc-arm-none-eabi"):
        profile(small, ["cortex-m4"])


CORE = replace(
    next(c for c in cores() if c.name == "esp32"),
    mhz=100,
    cycles_low=1.0,
    cycles_high=2.0,
    flash_mb_s=None,
    volts=2.0,
    ma=(10.0, 30.0),
)
SECTIONS = {
    "plushsense": {"text": 15_000, "others": 5_000, "rodata": 0, "data": 0, "bss": 0},
    "plush_model": {"text": 0, "others": 0, "rodata": 10_000, "data": 0, "bss": 0},
}


def test_a_cost_adds_up_its_sections_and_names_what_it_should_not_need() -> None:
    sections = {
        "plushsense": {"text": 15_000, "others": 5_000, "rodata": 300, "data": 20, "bss": 7},
        "plush_model": {"text": 1, "others": 0, "rodata": 10_000, "data": 40, "bss": 0},
    }
    counts = {"step": 10, "step_most": 11, "even": 12, "gap": 13, "call_most": 14, "call_bound": 15, "begin": 16}
    needs = ("__addsf3", "__aeabi_i2d", "__divsi3", "_sbrk", "free", "memset")
    cost = Cost(
        "xtensa", **counts, stages={"clock": 3}, sections=sections, toy_bytes=500, memory_bytes=1000, stack_push=17,
        stack_begin=18, stack_memory_bytes=19, stack_functions={"f": 20}, needs=needs, masking=("wfi",),
    )  # fmt: skip
    assert cost.flash_bytes == 15_000 + 300 + 20 + 1 + 10_000 + 40
    assert cost.ram_bytes == 500 + 1000 + 20 + 7 + 40
    assert cost.running_bytes() == 10_320 + 10_040 and cost.running_bytes(with_model=False) == 10_320
    assert cost.to_json() == {
        "title": TARGETS["xtensa"].title,
        "instructions_per_step": 10,
        "instructions_per_step_most": 11,
        "instructions_per_step_even": 12,
        "instructions_longest_call": 13,
        "instructions_call_most": 14,
        "instructions_call_bound": 15,
        "instructions_begin": 16,
        "stages": {"clock": 3},
        "sections": sections,
        "flash_bytes": cost.flash_bytes,
        "ram_bytes": cost.ram_bytes,
        "toy_bytes": 500,
        "memory_bytes": 1000,
        "stack_push_bytes": 17,
        "stack_begin_bytes": 18,
        "stack_memory_bytes_call": 19,
        "stack_functions": {"f": 20},
        "needs": list(needs),
        "interrupts_off": ["wfi"],
        "heap": ["_sbrk", "free"],
        "floating_point": ["__addsf3", "__aeabi_i2d"],
    }


def test_estimates_are_a_band_and_a_verdict() -> None:
    core, sections = CORE, SECTIONS
    arch = Arch.parse("9d1_5d2", "4,6", channels=3, classes=4)

    def of(instructions: int, core: Core = core) -> Estimate:
        counts = dict.fromkeys(("step_most", "even", "gap", "call_most", "begin", "stack_push", "stack_begin"), 1)
        cost = Cost(
            target=core.target,
            step=instructions,
            **counts,
            call_bound=2 * instructions,
            stages={},
            sections=sections,
            toy_bytes=1,
            memory_bytes=1,
            stack_memory_bytes=1,
            stack_functions={},
            needs=(),
            masking=(),
        )
        found = estimate(core, cost, arch, 50.0)
        assert found is not None
        return found

    found = of(1_000_000)
    assert (found.low_ms, found.high_ms, found.call_ms, found.fits) == (10.0, 20.0, 40.0, "yes")
    assert found.energy_uj == (10.0 * 20, 20.0 * 60)
    assert found.verdict == "fits 20 Hz: yes, uses about 20 to 40 % of the core, 30 ms left a step"
    # 20 000 bytes that run or are read, for each of 5 frames at 10 MB/s, are 10 ms more; 10 000 of code 5 ms.
    flash = replace(core, flash_mb_s=10.0)
    slow = of(1_000_000, flash)
    assert (slow.low_ms, slow.core_ms, slow.flash_ms, slow.high_ms, slow.call_ms) == (10.0, 20.0, 10.0, 30.0, 42.0)
    assert of(1_000_000, replace(flash, model_in_flash=False)).flash_ms == 5.0
    assert found.to_json() == {
        "estimate": True, "chip": core.title, "mhz": 100, "counted_on": "xtensa", "instructions": 1_000_000,
        "cycles_per_instruction": [1.0, 2.0], "flash_mb_s": None, "low": 10.0, "high": 20.0, "of_it_flash": 0.0,
        "longest_call": 40.0, "energy_uj": [200.0, 1200.0], "volts": 2.0, "current_ma": [10.0, 30.0],
        "current_source": core.power, "fits": "yes", "verdict": found.verdict, "why": core.why,
    }  # fmt: skip
    assert slow.to_json()["of_it_flash"] == 10.0 and slow.to_json()["longest_call"] == 42.0
    assert of(2_500_000).fits == "yes" and of(5_000_000).fits == "unsure"
    assert of(4_000_000).verdict.startswith("fits 20 Hz: not sure, it would use about 80 to 160")
    assert of(6_000_000).verdict == "fits 20 Hz: no, it would use 120 % of the core or more"


def test_every_core_stands_on_a_target_that_counts() -> None:
    assert len({core.name for core in cores()}) == len(cores())
    for core in cores():
        assert TARGETS[core.target].counts
        assert 1.0 <= core.cycles_low < core.cycles_high <= 1.9 * core.cycles_low and core.why
        assert 0 < core.ma[0] <= core.ma[1] and 1.8 <= core.volts <= 3.6 and core.power
