"""The page in a real browser: headless Chromium, driven by selenium."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from PIL import Image
from scan_predictions import OBJECTS, result_of
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from articulate_ssl.inference.articulation import articulate, canonical_object, part_motion
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.viewer import html_page
from articulate_ssl.inference.viewer.scene import scene_of

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CHROMEDRIVER = shutil.which("chromedriver")
SWITCHES = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--window-size=1000,760"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
STATE_RANGES = {
    synthetic.laptop: [[-0.3, 1.7]],
    synthetic.drawer: [[-0.1, 0.3]] * 3,
    synthetic.arm: [[-1, 1], [0, 0.2]],
}
RIVAL = dict(rival=synthetic.laptop(angle=0.4, seed=3)[0], probability=0.87)

in_browser = pytest.mark.skipif(
    not (CHROMIUM and CHROMEDRIVER), reason="needs Chromium and chromedriver: `.ci/setup browser` installs them"
)


@pytest.fixture(scope="module")
def browser() -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for switch in SWITCHES:
        options.add_argument(switch)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(CHROMEDRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def open_page(browser, tmp_path):
    """Opens the page of a prediction as a double-click does; it must have kept silent and off the network."""
    browser.get("about:blank")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": []})
    for log in ("browser", "performance"):
        browser.get_log(log)

    def open_page(make, **changes):
        changes = {"state_range": torch.tensor(STATE_RANGES[make])} | changes
        result = result_of(make, **changes)
        (file,) = html_page.write(result, tmp_path)
        browser.get(file.as_uri())
        WebDriverWait(browser, 20).until(lambda b: b.execute_script("return Boolean(window.articulated)"))
        return result

    yield open_page
    assert browser.get_log("browser") == []
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    urls = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert any(url.startswith("file:") for url in urls)
    assert [url for url in urls if not url.startswith(("file:", "data:"))] == []


def asked(browser, what):
    return np.array(browser.execute_script(f"return articulated.{what}()"))


def expected(prediction, states) -> np.ndarray:
    return (prediction.base_pose[0] @ part_motion(prediction, torch.tensor(states))[0]).numpy()


@in_browser
@pytest.mark.parametrize("make", OBJECTS)
def test_the_page_opens_at_the_predicted_states(browser, open_page, make):
    prediction = open_page(make).prediction
    np.testing.assert_allclose(asked(browser, "states"), prediction.joint_state[0])
    poses = asked(browser, "transforms")
    np.testing.assert_allclose(poses, expected(prediction, prediction.joint_state[0].tolist()), atol=1e-9)
    moved = canonical_object(prediction)[0].numpy() @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    np.testing.assert_allclose(moved, articulate(prediction, prediction.joint_state)[0], atol=1e-9)


@in_browser
@pytest.mark.parametrize("make", OBJECTS)
def test_a_slider_moves_the_parts_as_forward_kinematics_do(browser, open_page, make):
    prediction = open_page(make).prediction
    before = asked(browser, "states")
    sliders = browser.find_elements(By.CSS_SELECTOR, "input[type=range]")
    assert len(sliders) == len(before)
    for j, slider in enumerate(sliders):
        for keys in (Keys.HOME, Keys.ARROW_RIGHT * 7, Keys.END):
            slider.send_keys(keys)
            states = asked(browser, "states")
            assert abs(states[j] - before[j]) > 1e-3
            before = states
            np.testing.assert_allclose(asked(browser, "transforms"), expected(prediction, states.tolist()), atol=1e-9)


@in_browser
def test_a_slider_says_degrees_and_keeps_to_the_limits(browser, open_page):
    open_page(synthetic.laptop)
    slider, value = (browser.find_element(By.CSS_SELECTOR, f".joint {tag}") for tag in ("input", "output"))
    assert value.text == "68.8°"
    slider.send_keys(Keys.HOME, Keys.ARROW_LEFT)
    assert value.text == "\N{MINUS SIGN}17.2°"
    assert asked(browser, "states")[0] == pytest.approx(-0.3)
    slider.send_keys(Keys.END, Keys.ARROW_RIGHT)
    assert asked(browser, "states")[0] == pytest.approx(1.7)
    browser.find_element(By.ID, "reset-states").click()
    assert asked(browser, "states")[0] == pytest.approx(1.2)


@in_browser
def test_the_rival_is_shown_with_its_confidence(browser, open_page):
    result = open_page(synthetic.laptop, **RIVAL)
    labels = [label.text for label in browser.find_elements(By.CSS_SELECTOR, "#hypotheses label")]
    assert labels == ["Best hypothesis\n87% sure", "Rival hypothesis\nat most 13%"]
    best = asked(browser, "transforms")
    browser.find_element(By.ID, "hypothesis-1").click()
    assert asked(browser, "states")[0] == pytest.approx(0.4)
    rival = asked(browser, "transforms")
    np.testing.assert_allclose(rival, expected(result.rival, [float(result.rival.joint_state)]), atol=1e-9)
    assert np.abs(rival - best).max() > 0.1
    browser.find_element(By.ID, "hypothesis-0").click()
    np.testing.assert_allclose(asked(browser, "transforms"), best)


@in_browser
def test_what_is_unticked_disappears(browser, open_page):
    open_page(synthetic.laptop)
    names = ("scan", "reconstruction", "axes")
    for name in names:
        browser.find_element(By.ID, f"show-{name}").click()
    empty = picture_of(browser)
    inks = {}
    for name in names:
        with ticked(browser, name):
            inks[name] = difference(picture_of(browser), empty)
    assert difference(picture_of(browser), empty) == 0
    assert inks["reconstruction"] > 0.1 > inks["scan"] > 0.005 and 0.05 > inks["axes"] > 0.003


@in_browser
def test_parts_have_the_colours_of_the_other_files(browser, open_page):
    open_page(synthetic.laptop)
    pixels = picture_of(browser).reshape(-1, 3)
    for part in range(2):
        colour = part_colour(part).astype(float)
        light = pixels / pixels.max(axis=1, keepdims=True).clip(min=1)
        assert (np.abs(light - colour / colour.max()).max(axis=1) < 0.2).mean() > 0.03


@in_browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_readable_in_either_scheme(browser, open_page, scheme):
    media = {"media": "", "features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    open_page(synthetic.laptop)
    ink, ground = browser.execute_script(
        "const s = getComputedStyle(document.body); return [s.color, s.backgroundColor]"
    )
    assert (luminance(ground) > luminance(ink)) == (scheme == "light")
    low, high = sorted((luminance(ink), luminance(ground)))
    assert (high + 0.05) / (low + 0.05) > 7  # the strictest contrast that WCAG asks for


@in_browser
def test_a_drag_turns_the_view_and_the_button_turns_it_back(browser, open_page):
    open_page(synthetic.laptop)
    first = picture_of(browser)
    canvas = browser.find_element(By.CSS_SELECTOR, "canvas")
    webdriver.ActionChains(browser).drag_and_drop_by_offset(canvas, 150, 40).perform()
    assert difference(picture_of(browser), first) > 0.02
    browser.find_element(By.ID, "reset-view").click()
    assert difference(picture_of(browser), first) == 0


def test_the_page_is_one_file_of_about_a_megabyte(tmp_path):
    (file,) = html_page.write(result_of(synthetic.laptop), tmp_path)
    assert [file] == list(tmp_path.iterdir())
    assert file.name == "view.html" and 0.8e6 < file.stat().st_size < 1.3e6
    text = file.read_text()
    assert "{{" not in text.split("<script", 1)[0]
    assert 'src="' not in text.split("</style>")[1].split("<script")[0]


def test_a_name_cannot_break_out_of_the_page():
    scene = scene_of(result_of(synthetic.laptop, category="</script><b>{{scene}}"))
    page = html_page.page(scene)
    assert "</script><b>" not in page
    assert page.count('id="scene"') == 1


def test_the_licence_of_three_js_travels_with_it():
    assert "Copyright © 2010-2024 three.js authors" in html_page.page(scene_of(result_of(synthetic.laptop)))


@contextmanager
def ticked(browser, name: str) -> Iterator[None]:
    box = browser.find_element(By.ID, f"show-{name}")
    box.click()
    yield
    box.click()


def picture_of(browser) -> np.ndarray:  # [H, W, 3]
    png = browser.find_element(By.ID, "view").screenshot_as_png
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(float)


def difference(picture: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that clearly differ: more than the browser dithers the ground."""
    return float((np.abs(picture - other).max(axis=2) > 40).mean())


def luminance(colour: str) -> float:
    """Relative luminance of a CSS `rgb(…)`, after WCAG."""
    channels = np.array([float(c) for c in colour[colour.index("(") + 1 : -1].split(",")[:3]]) / 255
    return float(((channels + 0.055) / 1.055) ** 2.4 @ [0.2126, 0.7152, 0.0722])
