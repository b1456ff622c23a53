"""Exports with names: several link into one program, and each answers as alone; without a name nothing changes."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from plushsense.core.errors import BadInput, ConfigError
from plushsense.deploy.code import BUNDLE, code_files, prefixed, read_facts, without_prefix
from plushsense.deploy.golden import ANSWER, HEAD, read_golden
from plushsense.deploy.package import emit
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.quantize import integer_model
from support.exports import bundle_of
from support.virtual_boards import BOARDS, WARNINGS, run

STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Werror")
# Two networks of one layout, and one of another.
MODELS = {
    "left": partial(bundle_of, "accel-3", window=60),
    "right_2": partial(bundle_of, "accel-3", window=60, step=20, seed=3),
    "third": partial(bundle_of, "plush-15", window=60, seed=4),
}
_TOY = """
static uint32_t NAME_memory[BIG_PLUSH_MODEL_MEMORY_WORDS];
static NAME_plush_toy NAME;

static void NAME_answer(const NAME_plush_toy *of, void *user)
{
    uint8_t i;

    (void)user;
    if (of->answer.state != BIG_PLUSH_TRACKING)
        return;
    printf("NAME %lu", (unsigned long)of->answer.sample);
    for (i = 0; i < BIG_PLUSH_MODEL_CLASSES; i++)
        printf(" %ld", (long)of->logits[i]);
    printf("\\n");
}

static int NAME_begin(void)
{
    NAME_plush_status status =
        NAME_plush_begin(&NAME, NAME_plush_model, BIG_PLUSH_MODEL_BYTES, NAME_memory, sizeof NAME_memory);

    NAME.on_answer = NAME_answer;
    return status == BIG_PLUSH_OK;
}

static int NAME_frame(void)
{
    uint8_t bytes[4 * (1 + BIG_PLUSH_MODEL_CHANNELS)];
    int32_t row[1 + BIG_PLUSH_MODEL_CHANNELS];

    if (fread(bytes, 1, sizeof bytes, stdin) != sizeof bytes)
        return 0;
    memcpy(row, bytes, sizeof row);
    NAME_plush_push(&NAME, (uint32_t)row[0], row + 1);
    return 1;
}
"""
FRAMES = 260


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("named")
    for name, make in MODELS.items():
        bundle = make()
        emit(integer_model(bundle), bundle, folder / name, name=name)
    return {name: folder / name for name in MODELS}


@pytest.mark.parametrize(("compiler", "suffix"), [(("gcc", "-std=c99"), "c"), (("g++", "-std=c++11"), "cpp")])
@pytest.mark.exhaustive_for("compiler1-cpp")
def test_several_models_in_one_program_answer_as_alone(
    named: dict[str, Path], needs: Callable[..., None], tmp_path: Path, compiler: tuple[str, ...], suffix: str
) -> None:
    """All headers in one source, all objects in one program; frames of the three come in turn."""
    needs("gcc", "g++")
    objects, includes = [], [f"-I{folder}" for folder in named.values()]
    for name, folder in named.items():
        for file in (f"{name}_plushsense.c", f"{name}_plush_model.c"):
            run("gcc", "-std=c99", "-O1", *STRICT, "-c", folder / file, "-o", tmp_path / f"{file}.o")
            objects.append(tmp_path / f"{file}.o")
    headers = [f'#include "{name}_{file}.h"\n' for name in named for file in ("plush_model", "plushsense")]
    toys = [_TOY.replace("NAME", name).replace("BIG", name.upper()) for name in named]
    turns = " && ".join(f"{name}_frame()" for name in named)
    begins = " && ".join(f"{name}_begin()" for name in named)
    body = f"int main(void)\n{{\n    if (!({begins}))\n        return 1;\n    while ({turns}) {{\n    }}\n"
    (tmp_path / f"main.{suffix}").write_text(
        "".join(["#include <stdio.h>\n#include <string.h>\n", *headers, *toys, body, "    return 0;\n}\n"])
    )
    program = tmp_path / f"all.{suffix}.run"
    run(*compiler, *STRICT, *includes, tmp_path / f"main.{suffix}", *objects, "-o", program)
    frames, expected = {}, []
    for name, folder in named.items():
        channels, classes = len(read_facts(folder).channels), read_facts(folder).classes
        frames[name], rows = read_golden(folder / "golden", channels, classes)
        rows = rows[(rows[:, 0] == ANSWER) & (rows[:, 1] < FRAMES) & (rows[:, 4] == 1)]
        expected += [f"{name} {row[3]} {' '.join(map(str, row[HEAD : HEAD + classes]))}" for row in rows.tolist()]
    stream = b"".join((frames[name][n] & 0xFFFFFFFF).astype("<u4").tobytes() for n in range(FRAMES) for name in named)
    done = subprocess.run([program], input=stream, capture_output=True, check=True)
    got = done.stdout.decode().splitlines()
    assert sorted(got) == sorted(expected) and len({line.split()[0] for line in got}) == 3 and len(got) > 60


def test_no_name_of_the_library_stays_without_the_prefix(named: dict[str, Path], needs: Callable[..., None]) -> None:
    """In files, symbols, guards and macros; but the command, and the file of the image, are called as ever."""
    for name, folder in named.items():
        for path in (p for p in folder.rglob("*") if p.suffix in (".c", ".h", ".ino", ".rs")):
            text = path.read_text(encoding="utf-8")
            assert re.findall(r"(?<!\w)(?:plush_|PLUSH)\w+(?!\w|\.bin)", text) == [], path
            assert re.findall(r"(?<!\w)plushsense\.[ch]\b", text) == [], path
            assert path.name.startswith(f"{name}_") or path.suffix == ".ino" or path.name == "main.c"
        assert (folder / "plush_model.bin").is_file() and f"`{name}_plush_push()`" in (folder / "README.md").read_text()
        assert Export(folder).changed == Export(folder).edited == ()
        assert (folder / "arduino" / f"{name}_plush" / "src" / f"{name}_plushsense.h").is_file()


def test_it_is_the_plain_export_with_a_prefix(named: dict[str, Path], tmp_path: Path) -> None:
    bundle = MODELS["left"]()
    plain = emit(integer_model(bundle), bundle, tmp_path / "plain").folder
    for file in ("plushsense.h", "plushsense.c", "plush_model.h", "plush_model.c"):
        text = (named["left"] / f"left_{file}").read_bytes()
        assert without_prefix(text, "left") == (plain / file).read_bytes()
        assert prefixed((plain / file).read_text(encoding="utf-8"), "left").encode() == text
    for file in ("plush_model.bin", BUNDLE, "golden/answers.bin"):
        assert (named["left"] / file).read_bytes() == (plain / file).read_bytes()
    assert not read_facts(plain).name and read_facts(named["left"]).name == "left"


def test_it_is_verified_and_changes_are_found(named: dict[str, Path], tmp_path: Path) -> None:
    """`verify` and `profile` compile what a plain export holds."""
    own = Export(named["left"])
    code = own.code(tmp_path / "own")
    assert own.changed == () and own.is_own
    assert {p.name: p.read_bytes() for p in code.iterdir()} == code_files(own.model, own.bundle)
    folder = Path(shutil.copytree(named["left"], tmp_path / "left"))
    source = folder / "left_plushsense.c"
    source.write_text(source.read_text(encoding="utf-8") + "int broken = ;\n", encoding="utf-8")
    changed = Export(folder)
    assert changed.changed == ("left_plushsense.c",)
    with pytest.raises(BadInput, match="left_plushsense.c in"):
        changed.require_unchanged()
    assert b"int broken" in (changed.code(tmp_path / "code") / "plushsense.c").read_bytes(), "with --trust"


def test_the_example_compiles_with_a_name(named: dict[str, Path], needs: Callable[..., None], tmp_path: Path) -> None:
    needs("gcc", "g++")
    library = named["left"] / "arduino" / "left_plush"
    sketch = library / "examples" / "PlushToy"
    includes = [f"-I{folder}" for folder in (BOARDS / "arduino", library / "src", sketch)]
    for source in (*(library / "src").glob("*.c"), *sketch.glob("*.c")):
        run("gcc", "-std=c99", *WARNINGS, *includes, "-c", source, "-o", tmp_path / "o")
    words = ["g++", "-std=c++17", *WARNINGS, "-DARDUINO_ARCH_ESP32", *includes]
    run(*words, "-c", BOARDS / "arduino" / "run.cpp", "-o", tmp_path / "o")


@pytest.mark.parametrize("name", ["Left", "2nd", "a__b", "a_", "_a", "eleven_more", "my_arduino", "a-b", "ä", "a\n"])
def test_a_name_that_no_tool_takes_is_refused(tmp_path: Path, name: str) -> None:
    bundle = MODELS["left"]()
    with pytest.raises(ConfigError, match="cannot be the name of an export: accepted are"):
        emit(integer_model(bundle), bundle, tmp_path / "out", name=name)
    assert not list(tmp_path.iterdir())
