"""Tests of replay pages in a real browser, loaded from disk without a network."""

import html
import itertools
import os
import shutil

import pytest
from example_films import episode

from jaxswarm.render import page as pages

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FILMS = {
    "points": {"num_evaders": 2, "num_frames": 60},
    "boxes": {"num_boxes": 6, "num_frames": 60},
    "a large swarm": {"num_agents": 200, "num_frames": 300, "shares": False},
}
SIZES = {"desktop": (1280, 800), "phone": (390, 844)}

pytestmark = pytest.mark.slow
playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: pip install -e '.[dev]'")
if CHROMIUM is None:
    pytest.skip("Chromium is not installed: apt-get install chromium", allow_module_level=True)


@pytest.fixture(scope="module")
def browser():
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=sandbox)
        yield browser
        browser.close()


@pytest.fixture
def show(browser, tmp_path):
    """Return a function that opens a page from disk, offline; errors, warnings and requests fail the test."""
    problems, contexts = [], []

    def show(text, size="desktop", **options):
        path = tmp_path / "replay.html"
        path.write_text(text, encoding="utf-8")
        width, height = SIZES[size]
        context = browser.new_context(viewport={"width": width, "height": height}, offline=True, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: problems.append(message.text) if message.type != "log" else None)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda request: problems.append(request.url) if request.url.startswith("http") else None)
        page.goto(path.as_uri())
        return page

    yield show
    for context in contexts:
        context.close()
    assert not problems


def ready(page):
    page.wait_for_selector("body[data-ready]")
    return page


def colors(page, canvas="figure canvas"):
    """Return the number of different colors on a canvas."""
    script = """canvas => {
      const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", {willReadFrequently: true});
      copy.drawImage(canvas, 0, 0);
      return new Set(new Uint32Array(copy.getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
    }"""
    return page.locator(canvas).first.evaluate(script)


def shown_step(page):
    return int(page.locator("#step").inner_text().split()[1])


def click_agent(page, agent, figure=0):
    """Click the place where the page draws an agent."""
    script = """([agent, figure]) => {
      const film = page.films[figure], box = film.canvas.getBoundingClientRect();
      const [x, y] = makeView(film, box.width).to(place(film, film.kinds[0], agent, page.step));
      return {x, y};
    }"""
    position = page.evaluate(script, [agent, figure])
    page.locator("figure canvas").nth(figure).click(position=position)


@pytest.mark.parametrize(("name", "size"), list(itertools.product(FILMS, SIZES)))
def test_a_page_draws_and_fits(show, name, size):
    page = ready(show(pages.html([episode(**FILMS[name])]), size))
    assert colors(page) > 20
    assert colors(page, "#timeline") > 2
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.locator("figure h2").inner_text() == "walk </script> <b>"


def test_a_page_plays_to_the_end_and_again(show):
    page = ready(show(pages.html([episode(num_evaders=1)])))
    page.select_option("#speed", "8")
    page.click("#play")
    page.wait_for_function("page.step > 5")
    page.wait_for_function("!page.playing")
    assert shown_step(page) == 39
    assert page.locator("#play").inner_text() == "Replay"
    page.select_option("#speed", "0.25")
    page.keyboard.press("Escape")
    page.click("#play")
    page.wait_for_function("page.step > 0 && page.step < 5")
    page.click("#play")
    stopped = page.evaluate("page.step")
    page.wait_for_timeout(100)
    assert page.evaluate("page.step") == stopped


def test_a_large_swarm_plays_at_30_frames_a_second(show):
    page = ready(show(pages.html([episode(**FILMS["a large swarm"])])))
    num_drawn = page.evaluate("page.drawn")
    page.click("#play")
    page.wait_for_timeout(2000)
    assert page.evaluate("page.drawn") - num_drawn >= 60


def test_a_page_scrubs_and_steps(show):
    film = episode(num_evaders=1)
    page = ready(show(pages.html([film])))
    page.locator("#scrub").fill("20")
    assert shown_step(page) == 20
    assert float(page.locator(".score span").inner_text().replace("\N{MINUS SIGN}", "-")) == pytest.approx(
        film.score[20], abs=0.006
    )
    page.click("#forward")
    assert shown_step(page) == 21
    page.locator("#timeline").click(position={"x": 10, "y": 10})
    assert shown_step(page) < 2
    page.locator("h2").click()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    assert shown_step(page) == 0


@pytest.mark.parametrize("size", SIZES)
def test_a_selected_agent_tells_what_it_looks_at(show, size):
    film = episode(num_evaders=2)
    page = ready(show(pages.html([film]), size))
    page.locator("#scrub").fill("12")
    num_colors = colors(page)
    click_agent(page, 4)
    selected = page.evaluate("page.films[0].selected")
    weights = page.locator(".weights")
    assert f"Agent {selected} perceives" in weights.inner_text()
    body = int(film.shares[12, selected, :6].argmax())
    percent = 100 * film.shares[12, selected, body]
    first = weights.locator("li").first.inner_text()
    assert first.startswith(f"agent {body} ")
    assert float(first.split()[2]) == pytest.approx(percent, rel=0.06)
    assert colors(page) > num_colors
    page.keyboard.press("Escape")
    assert "Select an agent" in weights.inner_text()


def test_a_swarm_without_weights_says_so(show):
    page = ready(show(pages.html([episode(shares=False)])))
    click_agent(page, 0)
    assert "too large" in page.locator(".weights").inner_text()


def test_films_play_side_by_side_in_step(show):
    page = ready(show(pages.html([episode(num_evaders=1), episode(num_frames=20, seed=1)])))
    one, two = (page.locator("figure canvas").nth(i).bounding_box() for i in range(2))
    assert one["y"] == two["y"]
    assert one["x"] + one["width"] <= two["x"]
    page.locator("#scrub").fill("39")
    assert colors(page) > 20  # the shorter film shows its last frame
    click_agent(page, 2, 0)
    assert page.evaluate("page.films.map(film => film.selected === null)") == [False, True]


def test_a_page_lives_in_a_notebook(show):
    """The frame of the notebook has an opaque origin."""
    source = html.escape(pages.html([episode(num_boxes=3)]), quote=True)
    page = show(f'<iframe sandbox="allow-scripts" style="width:600px;height:600px" srcdoc="{source}"></iframe>')
    frame = page.frame_locator("iframe")
    frame.locator("body[data-ready]").wait_for()
    frame.locator("#play").click()
    assert frame.locator("#play").inner_text() == "Pause"


def test_a_page_is_dark_where_people_like_it_dark(show):
    text = pages.html([episode()])
    schemes = [ready(show(text, color_scheme=scheme)) for scheme in ("light", "dark")]
    light, dark = (page.evaluate("getComputedStyle(document.body).backgroundColor") for page in schemes)
    assert light != dark
    assert all(colors(page) > 20 for page in schemes)
