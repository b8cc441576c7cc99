"""The definition of a changed picture."""

import numpy as np
import pytest
from PIL import Image

from vehsim.cli.commands import run
from vehsim.errors import InputError
from vehsim.exporters.compare.compare import compare_folders, compare_pictures, write_difference
from vehsim.exporters.pictures.passes import read_legend


@pytest.fixture
def pictures(tmp_path):
    rng = np.random.default_rng(0)
    picture = rng.integers(20, 230, (40, 60, 3), dtype=np.uint8)
    for folder in ("renders", "references"):
        (tmp_path / folder / "chase").mkdir(parents=True)
        Image.fromarray(picture).save(tmp_path / folder / "chase" / "a.png")
    return tmp_path, picture


def replace(pictures, change):
    root, picture = pictures
    path = root / "renders" / "chase" / "a.png"
    Image.fromarray(change(picture.astype(int)).astype(np.uint8)).save(path)
    return compare_pictures(path, root / "references" / "chase" / "a.png")


def test_equal_pictures_are_equal(pictures):
    root, _ = pictures
    assert [c.changed for c in compare_folders(root / "renders", root / "references")] == [0.0]


def test_one_bit_of_noise_is_not_a_change(pictures):
    assert replace(pictures, lambda p: p + 1).changed == 0.0


def test_a_changed_pixel_is_counted(pictures):
    def change(picture):
        picture[3, 4] = 255 - picture[3, 4] // 4
        return picture

    assert replace(pictures, change).changed == pytest.approx(1 / 2400)


def test_other_sizes_and_missing_pictures_say_so(pictures):
    root, _ = pictures
    assert "not 60 x 40" in replace(pictures, lambda p: p[:20]).reason
    (root / "renders" / "chase" / "a.png").unlink()
    assert compare_folders(root / "renders", root / "references")[0].reason == "was not rendered"


def test_nothing_to_compare_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"no \.png"):
        compare_folders(tmp_path, tmp_path / "missing")
    for folder, text in (("a", b"not a picture"), ("b", b"nor this")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.png").write_bytes(text)
    with pytest.raises(InputError, match="picture: cannot be read"):
        compare_folders(tmp_path / "a", tmp_path / "b")


def test_command_exits_1_and_draws_what_changed(pictures, capsys):
    root, _ = pictures
    folders = [str(root / "renders"), str(root / "references")]
    assert run(["compare", *folders]) == 0
    comparison = replace(pictures, lambda p: np.where(p > 120, p - 90, p))
    assert run(["compare", *folders, "--out", str(root / "out")]) == 1
    assert "% of its pixels changed" in capsys.readouterr().out
    assert (root / "out" / "index.html").is_file()
    assert write_difference(comparison, root / "d.png").is_file()


@pytest.mark.parametrize(
    ("kind", "pixels", "named"),
    [("segmentation", 14, True), ("segmentation", 10, False), ("colour", 14, True), ("colour", 10, False)],
)
def test_small_prims_may_not_vanish_or_change_their_colour(tmp_path, kind, pixels, named):
    """A prim of 14 pixels of 160000 is a hundredth of the permitted change of the whole picture."""
    from vehsim.exporters.pictures.passes import pass_path, prim_colours, write_legend

    paths = ["/shot/env/ground", "/shot/heli/hub"]
    ground, hub = prim_colours(paths)
    spot = np.zeros((400, 400), bool)
    spot[200, 100 : 100 + pixels] = True
    for folder in ("a", "b"):
        picture = tmp_path / folder / "main" / "shot.main.1001.png"
        beside = pass_path(picture, "segmentation")
        beside.parent.mkdir(parents=True)
        write_legend(paths, beside.parent)
        gone = spot if folder == "b" and kind == "segmentation" else np.zeros_like(spot)
        blue = spot if folder == "b" and kind == "colour" else np.zeros_like(spot)
        Image.fromarray(np.where((spot & ~gone)[..., None], hub, ground)).save(beside)
        Image.fromarray(np.where(blue[..., None], (0, 0, 200), (90, 90, 90)).astype(np.uint8)).save(picture)
    found = {each.kind: each for each in compare_folders(tmp_path / "b", tmp_path / "a")}
    assert found[kind].changed < found[kind].allowed
    assert found[kind].prims == (("/shot/heli/hub",) if named else ())
    text = "/shot/heli/hub is missing" if kind == "segmentation" else "most of /shot/heli/hub"
    assert found[kind].fails() is named and (text in str(found[kind])) is named
    assert found["colour"].fails(0.01) is False


@pytest.mark.parametrize(
    ("lost", "named"),
    [
        (("knuckle/wheel_fl/tyre", "knuckle/wheel_fl/spoke"), "/shot/cart/knuckle/wheel_fl is missing"),
        (("knuckle/wheel_fl/spoke",), "/shot/cart/knuckle/wheel_fl/spoke is missing"),
        (("tub",), "/shot/cart/tub is missing"),
        (("tub", "knuckle/wheel_fl/tyre", "knuckle/wheel_fl/spoke"), "/shot/cart is missing"),
    ],
)
def test_a_missing_wheel_is_named_and_not_the_empty_knuckle_above_it(tmp_path, lost, named):
    from vehsim.exporters.pictures.passes import pass_path, prim_colours, write_legend

    parts = ("tub", "knuckle/wheel_fl/tyre", "knuckle/wheel_fl/spoke")
    for folder in ("a", "b"):
        kept = [part for part in parts if folder == "a" or part not in lost]
        paths = ["/shot/env/ground", *(f"/shot/cart/{part}" for part in kept)]
        colours = dict(zip(paths, prim_colours(paths), strict=True))
        shown = np.tile(colours["/shot/env/ground"], (400, 400, 1))
        for k, part in enumerate(parts):
            shown[20 * k : 20 * k + 10, :200] = colours.get(f"/shot/cart/{part}", shown[-1, -1])
        beside = pass_path(tmp_path / folder / "main" / "shot.main.1001.png", "segmentation")
        beside.parent.mkdir(parents=True)
        write_legend(paths, beside.parent)
        Image.fromarray(shown).save(beside)
    (found,) = compare_folders(tmp_path / "b", tmp_path / "a")
    assert str(found).endswith(named)


@pytest.mark.parametrize("text", ["", "null", "[]", "[" * 3000, '{"#000001": 3}'])
def test_a_broken_legend_is_refused(tmp_path, text):
    (tmp_path / "legend.json").write_text(text)
    with pytest.raises(InputError, match=r"legend.json: legend: .*render it again"):
        read_legend(tmp_path)
