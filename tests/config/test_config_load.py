"""Reading a configuration: any text ends in a configuration or in one line that says the remedy."""

import json
import math
import re
from pathlib import Path

import jsonschema
import msgspec
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.config.build import framing, ground_camera, rule_settings, tracker_settings
from bikeped.config.load import (
    LoadedConfig,
    config_hash,
    default_config_path,
    load_calibration,
    load_config,
    parse_config,
)
from bikeped.config.schema import Config
from bikeped.config.validate import known_keys
from bikeped.errors import BikepedError, CalibrationError, ConfigError

TOP = Path(__file__).parents[2]
NO_FILE = "camera: {calibration: null, radius_px: 1750, fov_deg: 197.9}\n"
SCHEMA = msgspec.json.schema(Config)
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
KEYS = sorted(known_keys())


def parse(text, *overrides, base=None):
    return parse_config(text, "site.yaml", base or Path("nowhere"), overrides)


def problem(text, *overrides):
    """The refusal of a configuration, or None."""
    try:
        parse(text, *overrides)
    except BikepedError as error:
        return str(error)
    return None


def refusal(text, *overrides, base=None):
    """The one line of the refusal."""
    with pytest.raises(BikepedError) as refused:
        parse(text, *overrides, base=base)
    line = str(refused.value)
    assert "\n" not in line
    assert len(line) < 400
    return line


def with_key(key, value):
    """YAML of a usable configuration in which `key` is `value`."""
    data = yaml.safe_load(NO_FILE)
    node = data
    *sections, last = key.split(".")
    for section in sections:
        node = node.setdefault(section, {})
    node[last] = value
    return yaml.safe_dump(data)


def leaves(struct=Config, prefix=""):
    """(key, schema) of every leaf."""
    _, parts = msgspec.json.schema_components([Config], ref_template="{name}")
    for field in msgspec.structs.fields(struct):
        if isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            yield from leaves(field.type, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", parts[struct.__name__]["properties"][field.name]


# ---- the files at the top level


def test_the_files_at_the_top_level_load_and_fit():
    loaded = load_config(TOP / "config.yaml")
    assert loaded.calibration is not None
    assert loaded.config.decision == Config().decision  # the paper's selected configuration
    camera = ground_camera(loaded)
    assert camera.lens.focal_px == pytest.approx(1013.31, abs=0.01)
    assert loaded.calibration.focal_length == pytest.approx(camera.lens.focal_px, abs=1e-6)
    assert (camera.cx, camera.cy, camera.height_m) == (1752.69, 1804.54, 3.6576)
    assert camera.window_px == (0, 670, 3500, 2830)
    assert framing(loaded).crop_wh == (3500, 3500)
    assert VALIDATOR.is_valid(yaml.safe_load((TOP / "config.yaml").read_text()))
    calibration, data = load_calibration(TOP / "camera_calibration.json")
    assert calibration == loaded.calibration
    assert data == (TOP / "camera_calibration.json").read_bytes() == loaded.calibration_data
    assert re.fullmatch("[0-9a-f]{64}", loaded.hash)


def test_the_default_file_is_the_working_directorys_or_the_bundled_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert default_config_path().is_file()
    (tmp_path / "config.yaml").write_text(NO_FILE + "web: {port: 1234}\n")
    assert load_config().config.web.port == 1234


def test_settings_of_the_core_are_in_seconds():
    rule = rule_settings(Config().decision)
    assert rule.memory_s == 58 / 30
    assert rule.lookback_s == 2 / 30
    assert rule.speed_window_s == 4 / 30  # definitions, section 8: positions 4 frames apart
    assert rule_settings(Config().decision, 9).speed_window_s == 9 / 30
    slow = parse(with_key("decision.nominal_fps", 15)).config
    assert rule_settings(slow.decision).memory_s == 58 / 15
    tracker = tracker_settings(Config().tracking)
    assert tracker.max_speed_mps == (6.0, 20.0, 40.0)
    assert (tracker.max_unseen_s, tracker.match_radius_m, tracker.frame_s) == (10.0, 3.0, 1 / 30)


# ---- anything at all


@settings(derandomize=True, deadline=None, max_examples=300)
@given(
    st.one_of(
        st.text(max_size=60),
        st.text(alphabet="camerdton:{}[],-&*!|>#'\"%@ \n\t0x._19?~", max_size=80),
        st.sampled_from(KEYS).flatmap(
            lambda key: st.text(max_size=12).map(
                lambda text: key.replace(".", ": {", 1).replace(".", ": {") + ": " + text
            )
        ),
    )
)
def test_any_text(text):
    line = problem(text)
    assert line is None or re.match(r"site\.yaml: [^\n]+$", line)


anything = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.dates()
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)


@settings(derandomize=True, deadline=None, max_examples=150)
@given(st.dictionaries(st.sampled_from(KEYS), anything, max_size=4), st.sampled_from(KEYS))
def test_any_values_under_known_keys(values, override):
    data = yaml.safe_load(NO_FILE)
    for key, value in values.items():
        node = data
        *sections, last = key.split(".")
        for section in sections:
            node = node.setdefault(section, {})
        node[last] = value
    overrides = [f"{override}={values[override]}"] if override in values else []
    text = yaml.safe_dump(data, allow_unicode=True)
    line = problem(text, *overrides)
    if line is None:
        effective = json.loads(msgspec.json.encode(parse(text, *overrides).config))
        assert VALIDATOR.is_valid(effective)
        numbers = re.findall(r"'?(?:nan|inf|-inf)\b'?", repr(effective))
        assert all(number.startswith("'") for number in numbers)
    else:
        assert "\n" not in line


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("- a\n- b\n", "expected sections"),
        ("camera: [\n", "line 2: is not YAML"),
        ("a: b: c\n", "line 1: is not YAML"),
        ("camera: {height_m: \t1}\n\t- x", "is not YAML"),
        ("web: !!bool x\n", "not a usable YAML value"),
        ("web: !!int ''\n", "not a usable YAML value"),
        ("web: !!timestamp x\n", "not a usable YAML value"),
        ("web: !!python/object:os.system x\n", "is not YAML"),
        ("web: 2020-99-99\n", "not a usable YAML value"),
        ("web: {port: 0x" + "f" * 5000 + "}\n", "web.port: expected `int` <= 65535"),
        ("feedback: {gpio: {red: 0x" + "f" * 5000 + "}}\n", "feedback.gpio.red"),
        ("feedback: {gpio: {red: -1}}\n", "feedback.gpio.red"),
        ('mqtt: {host: "\\ud800"}\n', "line 1: is not YAML (a character that no text can hold)"),
        ('camera: {calibration: "a\\0b"}\n', "a character that no text can hold"),
        ("1: {a: b}\n", "top level: a key is not text"),
        ("camera: {1: 2}\n", "camera: a key is not text"),
        ("a: &a [1, 2]\nb: *a\n", "line 2: is not YAML (aliases are not allowed"),
        ("a: &a {<<: *a}\n", "aliases are not allowed"),
        ("web: [" + "[" * 300 + "]" * 300 + "]\n", "nested too deeply"),
        ("web: [" + "1," * 20_000 + "]\n", "too many values"),
        (
            "web: {port: 1}\ndecision: {}\nweb: {port: 2}\n",
            "line 3: is not YAML (web is given twice)",
        ),
        ("mqtt: {qos: 1, port: 9, qos: 0}\n", "qos is given twice"),
        ("camera: {calibration: ~nobody_here/x.json}\n", "nobody_here/x.json: cannot be read"),
        ("camera: {calibration: ''}\n", "cannot be read"),
        ("camera:\n", "camera: expected `object`, got `null`"),
    ],
    ids=lambda v: v[:24].strip() if len(v) < 2000 else "huge",
)
def test_bad_texts_get_one_line(text, part):
    assert part in refusal(text)


def test_files_that_cannot_be_read(tmp_path):
    for path, part in (
        (tmp_path / "none.yaml", "cannot be read (No such file or directory); give a config"),
        (tmp_path, "cannot be read (it is not a regular file)"),
        (tmp_path / "latin.yaml", "is not UTF-8 text"),
        (tmp_path / "long.yaml", "larger than 1 MB"),
    ):
        if path.suffix == ".yaml" and path.stem != "none":
            path.write_bytes(b"\xe9" if path.stem == "latin" else b"#" * 1_000_001)
        with pytest.raises(ConfigError, match=re.escape(part)) as refused:
            load_config(path)
        assert str(path) in str(refused.value)


# ---- unknown keys


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("decison: {}\n", "decison: unknown key; did you mean decision?"),
        ("decision: {d_mx_m: 1}\n", "decision.d_mx_m: unknown key; did you mean d_max_m?"),
        ("camera: {d_max_m: 1}\n", "camera.d_max_m: unknown key; did you mean decision.d_max_m?"),
        ("port: 1\n", "port: unknown key; did you mean mqtt.port?"),
        (
            "feedback: {sound: {volum: 1}}\n",
            "feedback.sound.volum: unknown key; did you mean volume",
        ),
        (
            "tracking: {position_weight: 0.2}\n",
            "tracking.position_weight: is now tracking.measurement_noise_pedestrian_m, and",
        ),
        ("web: {qqq: 1}\n", "web.qqq: unknown key; known here: enabled, host, port"),
        ('web: {"a\\nb": 1}\n', "web.a b: unknown key"),
    ],
)
def test_unknown_keys_are_refused_with_the_nearest_name(text, line):
    assert refusal(text).startswith(f"site.yaml: {line}")


def test_every_key_misspelt_is_found_again():
    for key in KEYS:
        line = refusal(with_key(f"{key}x", 1))
        assert f"{key}x: unknown key; did you mean" in line


# ---- ranges


def bounds_of(schema):
    for choice in [schema, *schema.get("anyOf", ())]:
        if choice.get("type") in {"integer", "number"} and "maximum" in choice:
            yield choice


def test_every_number_has_a_range_and_it_is_enforced():
    tried = 0
    for key, schema in leaves():
        types = {c.get("type") for c in [schema, *schema.get("anyOf", ())]}
        if not types & {"integer", "number"} or "enum" in schema:
            continue
        (bounds,) = bounds_of(schema)
        tried += 1
        low = bounds.get("minimum", bounds.get("exclusiveMinimum"))
        high = bounds["maximum"]
        outside = [low - 1, high + 1]
        if "exclusiveMinimum" in bounds:
            outside.append(low)
        if bounds["type"] == "number":
            outside += [math.nan, math.inf, -math.inf]
        for value in outside:
            line = refusal(with_key(key, value))
            assert f"site.yaml: {key}: " in line, value
            assert f"to {high:g}" in line
        assert not VALIDATOR.is_valid(yaml.safe_load(with_key(key, high + 1)))
        inside = [high] if "exclusiveMinimum" in bounds else [low, high]
        for value in inside:
            node = parse(accepted(key, value)).config
            for part in key.split("."):
                node = getattr(node, part)
            assert node == value
    assert tried > 55


def accepted(key, value):
    """YAML with `key` at a bound, and what must move with it so that the whole stays possible."""
    data = yaml.safe_load(with_key(key, value))
    if key == "decision.d_max_m":
        data["decision"]["d_min_m"] = 0
    if key == "decision.alert_on_frames":
        data["decision"]["alert_window_frames"] = 30
    if key == "decision.alert_window_frames":
        data["decision"]["alert_on_frames"] = 1
    if key == "decision.d_min_m":
        data["decision"]["d_max_m"] = 100
    return yaml.safe_dump(data)


def test_every_choice_is_enforced_and_every_type():
    for key, schema in leaves():
        choices = schema.get("enum") or next(
            (c["enum"] for c in schema.get("anyOf", ()) if "enum" in c), None
        )
        if choices:
            line = refusal(with_key(key, "zzz" if isinstance(choices[0], str) else 99))
            assert f"site.yaml: {key}: " in line
            assert "use one of" in line
            assert all(str(c) in line for c in choices)
            for choice in choices:
                assert isinstance(parse(with_key(key, choice)), LoadedConfig)
        assert f"site.yaml: {key}" in refusal(with_key(key, {"a": 1}))
        kinds = {c.get("type") for c in [schema, *schema.get("anyOf", ())]}
        if "boolean" in kinds:
            assert "`bool`" in refusal(with_key(key, 1))
        if "string" in kinds and "integer" not in kinds:
            assert f"site.yaml: {key}" in refusal(with_key(key, 12))


def test_texts_that_must_look_like_something():
    for key, bad, good in (
        ("mqtt.site", "a/b", "main-street"),
        ("mqtt.site", "a+", "x" * 64),
        ("mqtt.site", "x" * 65, "1"),
        ("detection.sha256", "abc", "0" * 64),
        ("camera.fourcc", "MJPEG", "YUYV"),
        ("mqtt.host", "", "10.0.0.1"),
    ):
        assert f"site.yaml: {key}: " in refusal(with_key(key, bad))
        assert isinstance(parse(with_key(key, good)), LoadedConfig)
    assert "use one of cpu, cuda, tensorrt" in refusal(with_key("detection.providers", ["gpu"]))


def test_what_no_single_key_can_say():
    line = refusal(NO_FILE + "decision: {d_min_m: 9, d_max_m: 8}\n")
    assert "decision.d_min_m: 9 is above decision.d_max_m 8" in line
    assert "camera.calibration: missing" in refusal("")
    assert "set both camera.radius_px" in refusal("camera: {radius_px: 1750}\n")
    assert "mqtt.cert_file and mqtt.key_file" in refusal(NO_FILE + "mqtt: {cert_file: a.pem}\n")


def test_geometry_that_cannot_be_is_a_config_error():
    for key, value, part in (
        ("camera.pad_size", 3000, "camera.pad_size: 3000 is smaller"),
        ("camera.crop_size", 4000, "camera.crop_size: 4000 is larger"),
        ("camera.projection", "orthographic", "fov_deg: 197.9 is outside"),
        ("camera.k1", -1.0, "k1..k4: the image radius stops growing"),
    ):
        with pytest.raises(ConfigError, match=re.escape(part)) as refused:
            ground_camera(parse(with_key(key, value)))
        assert str(refused.value).startswith("site.yaml")
    for name, proper in (("linear", "equidistant"), ("equalarea", "equisolid")):
        camera = ground_camera(parse(with_key("camera.projection", name)))
        assert camera.lens.projection == proper


# ---- overrides


def test_overrides():
    loaded = parse(
        NO_FILE + "decision: {d_max_m: 10}\n",
        "decision.d_max_m=20", "feedback.gpio.red=12", "feedback.gpio.blue=BLUE",
        "web.enabled=true",
        "detection.providers=[cpu]", "camera.pad_size=null", "camera.crop_size=",
        "latency.compensation='off'", " mqtt.host = broker ",
    )  # fmt: skip
    config = loaded.config
    assert config.decision.d_max_m == 20
    assert (config.feedback.gpio.red, config.feedback.gpio.blue) == (12, "BLUE")
    assert config.web.enabled is True
    assert config.detection.providers == ("cpu",)
    assert config.camera.pad_size is None
    assert config.camera.crop_size is None
    assert config.mqtt.host == "broker"
    assert loaded.source == "site.yaml"
    assert parse("", *[f"camera.{k}={v}" for k, v in (("radius_px", 9), ("fov_deg", 90))])


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("d_max_m", "expected SECTION.KEY=VALUE"),
        ("d_max_m=3", "expected SECTION.KEY=VALUE"),
        ("decision.=3", "expected SECTION.KEY=VALUE"),
        ("decision.d_max_m=[", "is not YAML"),
        ("decision.d_max_m=!!bool x", "not a usable YAML value"),
        ("decision.d_max_m=&a [*a]", "aliases are not allowed"),
        ("decision.d_max_m=abc", "decision.d_max_m: expected `float`"),
        ("decision.d_max_m=1000", "use a value above 0 to 100"),
        ("decision.d_mx_m=1", "did you mean d_max_m?"),
        ("camera.height_m.x=1", "camera.height_m is not a section"),
        ("mqtt.host=\udcff", "not YAML"),
        ("mqtt.\udcff=1", "no key holds"),
        ("web.port=0x" + "f" * 5000, "web.port"),
        ("a.b=1\n2", "--set"),
    ],
    ids=lambda v: ascii(v)[:30],
)
def test_bad_overrides_get_one_line(override, part):
    text = "camera: {radius_px: 1750, fov_deg: 197.9, height_m: 3}\n"
    if override.startswith("camera.height_m.x"):
        part = "height_m"
    assert part in refusal(text, override)


def test_a_path_that_is_typed_is_relative_to_where_one_stands(tmp_path, monkeypatch):
    site, here = tmp_path / "site", tmp_path / "here"
    site.mkdir()
    here.mkdir()
    monkeypatch.chdir(here)
    (site / "config.yaml").write_text(NO_FILE + "audit: {path: log/a.jsonl}\n")
    loaded = load_config(site / "config.yaml")
    assert loaded.path(loaded.config.audit.path) == site / "log" / "a.jsonl"
    loaded = load_config(site / "config.yaml", ["audit.path=b.jsonl"])
    assert loaded.path(loaded.config.audit.path) == here / "b.jsonl"
    monkeypatch.setenv("HOME", str(tmp_path))
    loaded = load_config(site / "config.yaml", ["audit.path=~/c.jsonl"])
    assert loaded.path(loaded.config.audit.path) == tmp_path / "c.jsonl"
    assert loaded.path("~nobody_here/d") == site / "~nobody_here/d"


# ---- calibration


FITTING = {
    "model": "equidistant", "cx": 1752.69, "cy": 1804.54, "focal_length": 1013.3, "fov_deg": 197.9,
    "frame_width": 3840, "frame_height": 2160, "pad_size": 3840, "crop_size": 3500,
}  # fmt: skip


def calibrated(tmp_path, text="", **changes):
    values = {k: v for k, v in {**FITTING, **changes}.items() if v is not ...}
    (tmp_path / "lens.json").write_text(json.dumps(values))
    return parse(f"camera: {{calibration: lens.json, {text}}}\n", base=tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "part"),
    [
        ("crop_size", 3400, "camera.crop_size is 3500, the calibration was made with 3400"),
        ("pad_size", 4000, "camera.pad_size is 3840"),
        ("frame_width", 1920, "camera.width is 3840"),
        ("frame_height", 1080, "camera.height is 2160"),
        ("cx", 3501.0, "lies outside the crop of 3500 px"),
        ("cy", -1.0, "lies outside the crop of 3500 px"),
        ("focal_length", 0, "focal_length"),
        ("focal_length", "long", "focal_length"),
        ("focal_length", ..., "focal_length"),
        ("fov_deg", 400, "fov_deg"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(tmp_path, key, value, part):
    with pytest.raises(BikepedError) as refused:
        calibrated(tmp_path, **{key: value})
    line = str(refused.value)
    assert line.startswith(str(tmp_path / "lens.json"))
    assert part in line
    assert "\n" not in line


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"\xff\xfe", b'{"model": "\\ud800"}', b"NaN"])
def test_a_calibration_that_is_none(tmp_path, data):
    (tmp_path / "lens.json").write_bytes(data)
    with pytest.raises(CalibrationError, match=r"lens\.json: .*camera_calibration\.json"):
        load_calibration(tmp_path / "lens.json")


def test_keys_override_the_calibration(tmp_path):
    camera = ground_camera(calibrated(tmp_path, k1=0.01, k2=0.002))
    assert camera.lens.focal_px == 1013.3
    assert camera.lens.k == (0.01, 0.002, 0, 0)
    camera = ground_camera(calibrated(tmp_path, "k1: 0, cx: 1700, radius_px: 1750", k1=0.01))
    assert camera.lens.k == (0, 0, 0, 0)
    assert (camera.cx, camera.cy) == (1700, 1804.54)
    assert camera.lens.focal_px == pytest.approx(1013.316, abs=1e-3)
    camera = ground_camera(calibrated(tmp_path, "projection: equalarea, fov_deg: 180"))
    assert camera.lens.projection == "equisolid"
    assert camera.lens.max_theta_rad == pytest.approx(math.pi / 2)
    with pytest.raises(ConfigError, match="unknown model 'fishy'"):
        ground_camera(calibrated(tmp_path, model="fishy"))


# ---- hash


def test_the_hash_knows_values_and_not_how_they_are_written(tmp_path):
    plain = parse(NO_FILE + "decision: {d_max_m: 20, rule: ttc}\nweb: {port: 1}\n")
    other = """
# A comment.
web:
  "port": 0x1
"decision":
  rule: 'ttc'
  d_max_m: 20.0
  d_min_m: 1.9      # the default, written out
camera: {fov_deg: 197.90, calibration: ~, radius_px: 1_750}
"""
    assert parse(other).hash == plain.hash
    assert (
        parse(NO_FILE, "decision.d_max_m=20", "decision.rule=ttc", "web.port=1").hash == plain.hash
    )
    assert parse_config(NO_FILE, "elsewhere", tmp_path).hash == parse(NO_FILE).hash
    assert config_hash(plain.config) == plain.hash


def test_the_hash_changes_with_every_value_and_with_the_calibration(tmp_path):
    hashes = {parse(NO_FILE).hash}
    changed = {
        "decision.d_max_m": 24.9, "decision.memory_frames": 59, "camera.height_m": 3.7,
        "mqtt.site": "x", "feedback.gpio.red": "1", "detection.providers": ["cpu"],
    }  # fmt: skip
    hashes |= {parse(with_key(key, value)).hash for key, value in changed.items()}
    hashes.add(parse(with_key("feedback.gpio.red", 1)).hash)
    assert len(hashes) == len(changed) + 2
    first = calibrated(tmp_path)
    second = calibrated(tmp_path, focal_length=1013.4)
    assert first.config == second.config
    assert first.hash != second.hash


def test_the_hash_is_the_same_on_every_day_and_machine():
    # A change of this value is a change of what every audit log refers to: make it knowingly.
    text = msgspec.json.encode(Config(), order="deterministic").decode()
    assert json.loads(text)["decision"]["d_max_m"] == 24.8
    assert config_hash(Config()) == config_hash(msgspec.json.decode(text, type=Config))


# ---- schema


def test_the_schema_accepts_the_effective_configuration_and_refuses_what_the_loader_refuses():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert VALIDATOR.is_valid(json.loads(msgspec.json.encode(Config())))
    for text in ("decison: {}", "web: {port: -1}", "decision: {rule: best}", "web: {port: x}"):
        assert not VALIDATOR.is_valid(yaml.safe_load(text))
