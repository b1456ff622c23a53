"""The folder web of an export: the module in Node gives the answers of Python, and the page needs no network."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from plushsense.cli.export import format_profile
from plushsense.cli.main import main
from plushsense.deploy import wasm
from plushsense.deploy.golden import ANSWER, COLUMNS, HEAD, answers_of
from plushsense.deploy.package import emit
from plushsense.deploy.profile import profile
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import verify
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.web import MODULE, PAGE, SCRIPT
from plushsense.runtime.image import patch_bytes
from support.exports import bundle_of, exported

HOOK = Path(__file__).parents[2] / ".ci" / "hatch_build.py"
DRIVER = """
import { readFileSync } from "node:fs";
const { open, PlushError } = await import(process.argv[2]);
const { images, frames, more, other } = JSON.parse(readFileSync(0));
const bytes = (text) => new Uint8Array(Buffer.from(text, "base64"));
const refused = (call) => {
  try { call(); return "taken"; } catch (e) { return e instanceof PlushError ? e.message : "not one of ours"; }
};
const said = {};
const toy = await open(bytes(images[0]));
said.opening = [];
for (const image of images.slice(1)) said.opening.push(await open(bytes(image)).then(() => "taken", (e) => e.message));
const modules = [bytes(images[1]), new WebAssembly.Module(new Uint8Array([0, 97, 115, 109, 1, 0, 0, 0]))];
said.wasm = [];
const named = (e) => `${e.name}: ${e.message}`;
for (const wasm of modules) said.wasm.push(await open(bytes(images[0]), wasm).then(() => "taken", named));
const rows = [];
toy.onAnswer = (a) => rows.push([a.ms, a.sample, a.gesture, a.confidence * 32768, a.known, toy.probabilities().length]);
toy.onEvent = () => toy.swap(bytes(other));
said.uncaught = [];
process.on("uncaughtException", (e) => said.uncaught.push(e.message));
for (const [n, frame] of frames.entries()) {
  toy.push(frame.slice(1), frame[0]);
  if (n % 50 === 0) said.swapping = images.slice(1).map((image) => refused(() => toy.swap(bytes(image))));
}
said.before = rows.splice(0);
toy.onEvent = null;
await new Promise(setImmediate);
const memory = toy.bytes;
for (let n = 0; n < 40; n++) toy.swap(bytes(n % 2 ? images[0] : other));
toy.swap(bytes(other));
said.grown = toy.bytes - memory;
for (const frame of more) toy.push(frame.slice(1), frame[0]);
said.after = rows.splice(0);
said.events = toy.events().every((e) => ["begun", "named", "ended"].includes(e.what));
said.counts = toy.counts();
said.patches = [images[1], images[0]].map((image) => refused(() => toy.patch(bytes(image))));
const wrong = [[[1], 5], [null, 5], [[1, 2, 3]], [[1, 2, 3], NaN], [[1, 2, 3], "5"], [[1, 2, 3], 5n]];
wrong.push([[1n, 2n, 3n], 5], [[1, "x", 3], 5], [[1, Object.create(null), 3], 5], [[Symbol("one"), 2, 3], 5]);
said.reading = wrong.map((given) => refused(() => toy.push(...given)));
said.nothing = refused(() => toy.swap("text"));
said.sensing = ["x", "5", 1.5, 5n, NaN, null, undefined, {}].map((steps) => refused(() => (toy.sensitivity = steps)));
said.sensitivity = [300, 2 ** 40, -129, -7].map((steps) => { toy.sensitivity = steps; return toy.sensitivity; });
toy.restart();
toy.push([null, 1, 2], 2 ** 32 - 10);
said.waiting = toy.counts().reading;
toy.push([5, 1, 2], 2 ** 32);
toy.push([5, 1, 2], 2 ** 32 + 10);
said.wrapped = [toy.counts().reading, toy.answer().state];
console.log(JSON.stringify(said));
"""


@pytest.fixture(scope="module")
def in_node(needs: Callable[..., None]) -> None:
    needs("node", "clang", "wasm-ld")


def text(data: bytes) -> str:
    return base64.b64encode(data).decode()


def test_the_library_in_javascript(in_node: None, tmp_path: Path) -> None:
    """Answers before and after a swap, damaged images of each kind, wrong readings; one module for any model."""
    bundle = bundle_of("accel-3", window=60)
    out = exported(tmp_path / "out", bundle)
    model = Export(out).model
    other = integer_model(bundle_of("accel-3", "5d1_3d2", "8,5", seed=9, window=60))
    image = model.to_bytes()
    patch = patch_bytes(model, replace(model, gestures=model.gestures))
    wrong = [b"", image[:30], image[:-1], image[:500] + bytes([image[500] ^ 1]) + image[501:], patch, bytes(200)]
    rng = np.random.default_rng(0)

    def frames(start: int) -> np.ndarray:
        walk = np.rint(np.cumsum(rng.normal(size=(300, 3)), axis=0) * 60).astype(np.int64)
        return np.column_stack([start + 10 * np.arange(300), walk])

    first, second = frames(1000), frames(9000)
    given = {"images": [text(i) for i in (image, *wrong)], "frames": first.tolist(), "more": second.tolist()}
    (tmp_path / "driver.mjs").write_text(DRIVER)
    done = subprocess.run(
        ["node", str(tmp_path / "driver.mjs"), (out / SCRIPT).as_uri()],
        input=json.dumps({**given, "other": text(other.to_bytes())}),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    at = [COLUMNS[ANSWER].index(name) for name in ("ms", "sample", "gesture", "confidence", "known")]
    for name, read, ran in (("before", model, first), ("after", other, second)):
        expected = answers_of(read, ran)
        expected = expected[expected[:, 0] == ANSWER]
        assert [row[:5] for row in said[name]] == expected[:, at].tolist(), name
        assert len(expected) > 20 and expected.shape[1] == HEAD + 2 * said[name][0][5]
    lists = ("opening", "wasm", "swapping", "patches", "reading", "sensing")
    refusals = [*(words for name in lists for words in said[name]), said["nothing"]]
    assert all(re.fullmatch(r"[A-Z][^\n]{20,}\.", words) for words in refusals), refusals
    assert set(said["uncaught"]) == {
        "onAnswer and onEvent cannot change the toy that calls them: do it when push() is over."
    }
    assert said["grown"] < 1 << 16 and said["events"] and said["counts"]["restarts"] == 0
    assert (
        said["sensitivity"] == [127, 127, -128, -7]
        and said["waiting"] == "waiting"
        and said["wrapped"] == ["first", "warming"]
    )


def test_every_number_of_calibrating_sensors_and_what_a_step_costs(in_node: None, tmp_path: Path) -> None:
    plain = bundle_of("accel-3", "3d1_2d2", "3,4", window=40)
    bundle = replace(plain, layout=replace(plain.layout, self_calibration=plain.layout.names))
    out = emit(integer_model(bundle), bundle, tmp_path / "out", name="ears").folder
    done = verify(Export(out), ["wasm"])
    assert done.passed and done.own and len(done.runs) == 1 and done.decisions > 500
    cost = profile(out, ["wasm"])
    assert cost.web is not None and 0 < cost.web.step_us < 5000 and cost.web.module_bytes < 40_000
    assert cost.to_json()["wasm"] == vars(cost.web) and "In a browser" in format_profile(cost)
    # Another module: what runs is that of the folder.
    (out / MODULE).write_bytes(wasm.module(calibrate=False))
    assert PAGE in Export(out).changed
    done = verify(Export(out), ["wasm"], trust=True)
    assert not done.passed and "another version" in (done.first or "")


def test_the_page_is_one_file_that_asks_for_nothing(in_node: None, tmp_path: Path) -> None:
    bundle = bundle_of("plush-15", "14d1_19d2_19d4", "8,12,16")
    out = exported(tmp_path / "out", bundle)
    page = (out / PAGE).read_text("utf-8")
    assert len(page.encode()) <= 120_000 and text((out / "plush_model.bin").read_bytes()) in page
    assert text((out / MODULE).read_bytes()) in page
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None and policy[1].startswith("default-src 'none'; ") and "connect-src" not in policy[1]
    for tag in ('script type="module"', "style"):
        (body,) = re.findall(rf"<{tag}>(.*?)</{tag.split()[0]}>", page, re.S)
        assert f"'sha256-{base64.b64encode(sha256(body.encode()).digest()).decode()}'" in policy[1]
    assert not re.search(r"(src|href)=\"(?!data:)", page)


def test_an_export_says_that_its_page_is_large(
    in_node: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for filters, said in (("8,12,16", False), ("32,48,64", True)):
        bundle_of("plush-15", "14d1_19d2_19d4", filters).save(tmp_path / "model.plush")
        assert main(["export", str(tmp_path / "model.plush"), str(tmp_path / filters)]) == 0
        size = (tmp_path / filters / PAGE).stat().st_size
        expected = f"has {-(-size // 1000)} kB: it works, but it is meant to have at most 120 kB"
        assert (expected in capsys.readouterr().err) == said == (size > 120_000)


def test_a_rebuild_is_the_same_and_the_wheel_holds_it(in_node: None, monkeypatch: pytest.MonkeyPatch) -> None:
    (compiler, *_) = wasm.compilers()
    made = {calibrate: wasm.compiled(compiler, calibrate=calibrate) for calibrate in (False, True)}
    assert made[False] and made[False] == wasm.module(calibrate=False) and made[True] == wasm.module(calibrate=True)
    interface = SimpleNamespace(BuildHookInterface=object)
    monkeypatch.setitem(sys.modules, "hatchling.builders.hooks.plugin.interface", interface)
    hook = ModuleType("hatch_build")
    exec(compile(HOOK.read_text(), str(HOOK), "exec"), vars(hook))
    build = hook.Modules()
    build.root, data = str(HOOK.parents[1]), {"force_include": {}}
    build.initialize("standard", data)
    held = {there: Path(here).read_bytes() for here, there in data["force_include"].items()}
    folder = "plushsense/deploy/web/plushsense"
    assert held == {f"{folder}.wasm": made[False], f"{folder}-calibrate.wasm": made[True]}


def test_without_a_compiler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = bundle_of("accel-3", window=60)
    bundle.save(tmp_path / "model.plush")
    monkeypatch.setattr(wasm, "compilers", list)
    monkeypatch.setattr(wasm, "WEB", tmp_path)
    wasm.module.cache_clear()
    try:
        out = tmp_path / "out"
        assert main(["export", str(tmp_path / "model.plush"), str(out)]) == 0
        assert "install Debian's clang and lld, or the Python package ziglang" in capsys.readouterr().err
        assert (out / SCRIPT).exists() and not (out / MODULE).exists() and not (out / PAGE).exists()
        assert Export(out).changed == ()
        assert main(["verify", str(out), "--target", "wasm"]) == 2
        assert "holds no web/plushsense.wasm" in capsys.readouterr().err
        # A wheel holds the module.
        (tmp_path / "plushsense.wasm").write_bytes(b"a module")
        done = emit(integer_model(bundle), bundle, tmp_path / "more")
        assert not done.page_note and (done.folder / MODULE).read_bytes() == b"a module"
    finally:
        wasm.module.cache_clear()
