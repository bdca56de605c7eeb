"""Settings of a run folder as plain data."""

import time

import pytest
from omegaconf import OmegaConf

from hdrqn_torchrl.runs.persistence.files import RunFileError
from hdrqn_torchrl.runs.settings.stored_settings import check_plain, read_settings


@pytest.fixture
def read(tmp_path):
    def from_text(text, **options):
        (tmp_path / "config.yaml").write_text(text)
        return read_settings(tmp_path / "config.yaml", **options)

    return from_text


VALUES = {
    "numbers": [0, -3, 0.5, 1e-3, 1e20, 2.5e-05, 3.0, float("inf"), 10**12],
    "texts": ["1e3", "true", "null", "~", "2001-01-01", "12:30:45", "0x1F", "a: b", "#", "", " ", "[", "*", "&a", "-"],
    "others": [True, False, None, [], {}, [[1], {"a": {"b": None}}]],
}  # fmt: skip


@pytest.mark.parametrize("kind", VALUES)
def test_values_written_by_train_py_come_back_with_their_types(read, kind):
    found = read(OmegaConf.to_yaml(OmegaConf.create({"a": VALUES[kind]})))
    assert found == {"a": VALUES[kind]} and repr(found) == repr({"a": VALUES[kind]})


OLD = """
env: {_target_: e, num_goals: 3, practice_steps: 7}
algo:
  sub: {learning_rate: 0.1, tau: 0.2, learning_rate_frames: '${total_frames}', precision: '${precision}'}
  meta:
    learning_rate: ${algo.sub.learning_rate}
    tau: ${algo.sub.tau}
    max_target: ${oc.select:env.num_goals,null}
    slice_len: ${oc.select:env.max_steps,50}
  phase_one: {max_frames: '${env.practice_steps}'}
logger:
  loggers:
  - tracking_uri: sqlite:///${output_root}/mlflow.db
    settings: {env: '${env}', algo: '${algo}', seed: '${seed}'}
seed: 5
precision: fp32
total_frames: 1000
output_root: out
"""


def test_references_of_earlier_versions_are_filled_in_from_the_same_file(read):
    found = read(OLD)
    assert found == OmegaConf.to_container(OmegaConf.create(OLD), resolve=True)
    assert found["algo"]["meta"] == {"learning_rate": 0.1, "tau": 0.2, "max_target": 3, "slice_len": 50}
    assert found["logger"]["loggers"][0]["settings"]["algo"] == found["algo"]
    assert list(found) == list(OmegaConf.create(OLD))


@pytest.mark.parametrize(
    "text",
    [
        "a: ${oc.env:HOME}",
        "a: ${b}\nb: 1",
        "env: ${env}",
        "algo: {a: '${env}'}\nenv: {}",
        "total_frames: ${total_frames}",
        "a: ${total_frames}",
        "a: ${seed}\nseed: ${oc.env:HOME}",
        "a: ${seed}\nseed: [1]",
        "a: ' ${seed}'\nseed: 1",
        "a: [b, {c: '${total_frames }'}]\ntotal_frames: 3",
        r"a: \${x}",
        "logger: {loggers: [{settings: {a: '${algo}'}}]}",
        "logger: ['${logger}']",
    ],
)
def test_any_other_reference_is_refused_by_its_path_or_shown_unchanged(read, monkeypatch, text):
    monkeypatch.setenv("HOME", "/secret")
    with pytest.raises(
        RunFileError, match=r"config\.yaml can't be read as the settings of a run: \S+ must be a value, got '"
    ):
        read(text)
    assert "${" in str(read(text, keep_unknown=True)) and "secret" not in str(read(text, keep_unknown=True))


LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (LAUGHS, "anchors and aliases"),
        ("a: &a [*a]", "anchors and aliases"),
        ("a: {b: &b 1}\nc: {<<: *b}", "anchors and aliases"),
        ("a: " + "[" * 31 + "]" * 31, "nested more than 30 deep"),
        ("[" * 100_000, r"nested|depth|expected"),
        ("{a: " * 100_000, r"nested|depth|expected"),
        ("a: " + ":".join(["59"] * 100_000), "longer than 10,000 characters"),
        ("a: " + "9" * 9_000, "4300|digits"),
        ("a: !!python/object/apply:os.system [true]", "tags"),
        ("a: !!binary aaaa", "tags"),
        ("a: 1\na: 2", "occur only once"),
        ("3: 4", "every key must be a name"),
        ("? [1, 2]\n: 4", "every key must be a name"),
        ("", "must hold settings by name, got NoneType"),
        ("[1]", "must hold settings by name, got list"),
        ("a: [", "expected|did not find"),
        ("a: \x00", "control characters|unacceptable|not allowed"),
        ("a: 1\n---\nb: 2", "expected a single document"),
        ("a: " + "x" * (1 << 20), "at most 1,048,576 bytes"),
    ],
    ids=range(19),
)  # fmt: skip
def test_a_malicious_file_is_refused_at_once_in_one_sentence(read, text, told):
    started = time.monotonic()
    with pytest.raises(RunFileError, match=rf"config\.yaml (can't be read|must have).*({told})") as refusal:
        read(text)
    assert time.monotonic() - started < 3 and "\n" not in str(refusal.value)


@pytest.mark.parametrize("settings", [{"a": [{"b": "${c}"}]}, {"a": [{"b": float("nan")}]}], ids=str)
def test_references_and_nan_are_refused_by_their_path(settings):
    with pytest.raises(ValueError, match=r"^a\[0\]\.b must be a "):
        check_plain(settings)
    check_plain({"a": [1, None, "b$", {"c": float("inf")}]})
