"""A model's page: everything that is known stands on it, as text, whatever names it has."""

from __future__ import annotations

from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest

from appearance.bsdf.maps import HairMaps
from reconstruction import Mesh, Model, Report, Strands
from reconstruction.report.report import Series
from stage_service.cli import main
from stage_service.model_page import model_page, write_page

EVIL = "<img src=x onerror=alert(1)> & \"'"


class Page(HTMLParser):
    """What a browser would make of it: elements, attributes, text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        self.text = " ".join("".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    def values(self, name: str) -> list[str]:
        return [a[name] for _, a in self.elements if name in a]


@pytest.fixture
def model(tmp_path):
    """Two strands, 100 and 60 mm long and 50 µm thick, a report, a fit with its error, results."""
    model = Model(tmp_path / "a <b> & c").create()
    lines = [np.array([[0, 0, 0], [0, 0, x]]) for x in (0.1, 0.06)]
    model.write_strands(Strands.from_list(lines, radius=5e-5))
    report = Report()
    with report.stage("growth_of_strands") as stage:
        stage.figures = {"off_mm": {"p10": 0.25, "p50": 0.5, "p90": 1.5}, "name": EVIL}
        stage.series.append(Series("solver", EVIL, [(0.0, 1.0), (2.0, 0.1), (3.0, 0.0)]))
        stage.leave_out("voxels " + EVIL, "no hair", "3 of 4")
        stage.warn("look here: " + EVIL)
    model.write_report(report)
    hair = {"sigma_a": [0.1, 0.2, 0.4], "beta_m": 0.33, "beta_n": 0.2}
    fit = {"hair": hair, "colour": [1.0, 0.5, 0.0], "skin": [0.2, 0.2, 0.2]}
    fit["beta_m_interval"] = [0.28, 0.39]
    fit["sigma_a_error"] = [0.05, 0.06, None]
    model.write_json("appearance.json", fit)
    model.write_png("relit.png", np.zeros((2, 2, 3), np.uint8))
    model.write_png("plots/geometry.png", np.zeros((2, 2, 3), np.uint8))
    (model.path / 'x"y?.txt').write_text("a user's own")
    score = {"1mm_10deg": {"precision": 0.5, "recall": 0.25, "f": 1 / 3}}
    results = {
        "geometry": {
            **{"visible": score, "all": score},
            "connectivity": {"true": {"strand_consistency": {"1mm_10deg": 0.123}}},
        },
        "baselines": {"hull_vertical": {"visible": score, "all": score}},
        "images": {"held_out_lights": {"ours": {"psnr": 17.25, "ssim": 0.5}}},
        "appearance": {"fitted": {"beta_m": 0.33}, "true": {"beta_m": 0.28}},
    }
    model.write_json("results.json", results)
    return model


def test_everything_that_is_known_stands_on_the_page(model):
    text = Page(model_page(model)).text
    for said in (
        *("2 of 4 points", "0 m in all; a strand 100 mm, median", "50 µm"),
        "β_M 0.33, for rendering these strands; 95 % interval 0.28 to 0.39",
        *("σ_a 0.1 ± 5%, 0.2 ± 6%, 0.4"),
        *("growth of strands look here", "voxels", "no hair", "3 of 4"),
        *("off mm0.5 (0.25 to 1.5: 10 to 90 %)", "50.0 / 25.0 / 33.3", "hull + vertical"),
        "strand consistencyours12.3",
        *("17.2 dB / 0.50", "0.280", "1 files"),
    ):
        assert said.replace("0.280", "0.28") in text, said
    assert text.count("<img src=x onerror=alert(1)>") >= 5  # as text


def test_a_file_that_a_fit_removes_meanwhile_is_not_on_the_page(model, monkeypatch):
    there = model.artifacts()
    gone = model.checkpoint("spatial")
    monkeypatch.setattr(Model, "artifacts", lambda _: {**there, gone.name: gone})
    text = Page(model_page(model)).text
    assert gone.name not in text
    assert "strands.hair" in text


def test_a_head_that_nobody_measured_is_called_what_it_is(model):
    report = model.report()
    with report.stage("head") as stage:
        stage.figures = {"template": "generic head", "source": "skin " + EVIL, "rms_mm": 1.24}
    model.write_report(report)
    said = "head.obj: the generic head fitted to skin <img"
    assert said not in Page(model_page(model)).text, "refused: there is no head"
    model.write_head(Mesh(np.eye(3), np.array([[0, 1, 2]])))
    text = Page(model_page(model)).text
    assert said in text
    assert "1.2 mm rms" in text


def test_names_and_messages_are_text_and_nothing_runs_or_is_fetched(model):
    page = Page(model_page(model))
    assert page.open == []
    assert {tag for tag, _ in page.elements}.isdisjoint({"script", "iframe", "object", "link"})
    assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)
    paths = [unquote(p) for p in page.values("src") + page.values("href") if p[0] != "#"]
    assert [p for p in paths if not (model.path / p).is_file()] == []
    assert {"relit.png", "strands.usdc", 'x"y?.txt', "plots/geometry.png"} <= set(paths)
    marks = page.values("id")
    assert [p for p in page.values("href") if p[0] == "#" and p[1:] not in marks] == []


def test_colours_are_shown_as_srgb(model):
    """Linear 0.5 is 188 on a screen (IEC 61966-2-1)."""
    assert any("rgb(255,188,0)" in style for style in Page(model_page(model)).values("style"))


def test_rendered_and_missing_fits_are_listed_separately(model):
    report = model.report()
    with report.stage("inverse_rendering"):
        pass
    model.write_report(report)
    sigma = np.ones((3, 2, 2, 3)) * np.array([0.1, 0.2, 0.4])[:, None, None, None]
    sigma[2, ..., 0] = 0.8, 1.6  # a mean over the scalp of 1.2
    maps = HairMaps(sigma, np.zeros((3, 2, 2, 2)), 0.33, 0.3, 1.55, 2.0)
    maps.save(model, np.zeros((1, 2)))
    model.write_arrays("field.npz", {"a": np.zeros(1)})
    assert "not used" not in (text := Page(model_page(model)).text)
    assert "rendered inverse rendering" in text.replace("renderedinverse", "rendered inverse")
    assert (
        "β_M 0.33; root σ_a 0.1, 0.1, 0.1; middle σ_a 0.2, 0.2, 0.2; tip σ_a 1.2, 0.4, 0.4" in text
    )
    assert "reflectance that the material lacks" in text
    model.remove("hair_maps.npz")
    text = Page(model_page(model)).text
    assert "rendered inverse rendering" not in text.replace("renderedinverse", "rendered inverse")
    assert "validation frames" not in text  # the frames need not have preferred the other


def test_a_page_of_little_is_a_page(tmp_path, capsys):
    empty = Model(tmp_path / "empty").create()
    assert "There are no strands yet" in Page(model_page(empty)).text
    assert main(["page", str(empty.path), "--json"]) == 3
    assert "not a model" in capsys.readouterr().out
    empty.write_strands(Strands.from_list([]))
    assert main(["page", str(empty.path)]) == 0
    text = Page((empty.path / "index.html").read_text()).text
    assert "no material" in text
    assert "Warnings" not in text  # nobody looked


def test_a_page_does_not_outlive_what_it_is_of(model):
    page = write_page(model)
    assert "index.html" in model.artifacts()
    model.write_strands(model.strands())
    assert not page.exists()
