"""How long a page takes to answer a slider, seen in a headless Chromium: `python -m tests.bench.explore`.

Three users, and a slider that is on no axis, so that the region is another at each move. A time is from the
key to the frame in which the answer is painted, on the clock on the wall, as a person waits: browser, server
and those who compute share the cores. First single moves, then a key held down.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import apc
from tests.bench.judge import Judge, parser_of
from tests.surfaces.pages import CHROMIUM, MODEL, Tab, launched, served
from tests.topologies import AVERAGE

SLIDER = "device.damping"
ANSWERS = {"verdict": "verdict", "region": "region-words"}
# Moves one by one, and ms between them; for so many ms a key is held down, which repeats after so many.
MOVES, REST = 24, 900
HELD, REPEAT = 2000, 33
# Seconds of an answer to a move, the region in it.
MOVED_S = 0.1

# Each change of a text, when the frame that shows it is painted: figures that changed before it are drawn in
# the same frame, and a message is heard after the frame.
WATCH = f"""names => {{
  window.keys = []
  window.seen = Object.fromEntries(names.map(name => [name, []]))
  document.addEventListener('keydown', () => window.keys.push(performance.now()), true)
  for (const name of names) {{
    {MODEL}(name).properties.text.change.connect(
      () => requestAnimationFrame(() => {{
        const painted = new MessageChannel()
        painted.port1.onmessage = () => window.seen[name].push(performance.now())
        painted.port2.postMessage(null)
      }}))
  }}
}}"""


def main() -> None:
    """Print, and judge."""
    given = parser_of("explore", __doc__).parse_args()
    judge = Judge(given.strict)
    if CHROMIUM is None:
        sys.exit("no Chromium on this machine")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(AVERAGE, encoding="utf-8")
        with served(path) as link, launched() as browser:
            tab = Tab(browser, link)
            tab.page.wait_for_function(f"{MODEL}('region-words').text.includes('Stable in')")
            tab.page.wait_for_timeout(3 * REST)
            tab.page.evaluate(WATCH, list(ANSWERS.values()))
            _one_by_one(judge, tab)
            _held_down(tab)
            _right(judge, tab, path)
            tab.close(link)
    judge.end()


def _forget(tab: Tab) -> Any:
    """Forget what was seen; return the handle of the slider."""
    tab.page.evaluate(
        "() => { for (const one of [window.keys, ...Object.values(window.seen)]) one.length = 0 }"
    )
    return tab.page.get_by_role("slider", name=SLIDER, exact=True)


def _seen(tab: Tab) -> dict[str, Any]:
    """Return when a key was pressed and when which answer was painted, in ms."""
    tab.page.wait_for_timeout(REST)
    found: dict[str, Any] = tab.page.evaluate("() => ({keys: window.keys, ...window.seen})")
    return found


def _one_by_one(judge: Judge, tab: Tab) -> None:
    """Judge how long each answer takes after a move that nobody hurries."""
    handle = _forget(tab)
    for _ in range(MOVES):
        handle.press("ArrowRight")
        tab.page.wait_for_timeout(REST)
    seen = _seen(tab)
    print(f"{MOVES} moves of {SLIDER} one by one, three users: ms until it is painted")
    for answer, name in ANSWERS.items():
        own = [next(at for at in [*seen[name], float("inf")] if at > key) - key for key in seen["keys"]]
        median = statistics.median(own)
        word = judge.in_time(f"{answer} after a move [s]", median / 1e3, MOVED_S)
        print(f"  {answer:<8} median {median:.0f}, best {min(own):.0f}, worst {max(own):.0f}: {word}")


def _held_down(tab: Tab) -> None:
    """Print how often each answer is painted anew while a key is held down."""
    _forget(tab).evaluate(
        """(handle, [lasts, every]) => new Promise(done => {
          const how = {key: 'ArrowLeft', bubbles: true, composed: true}
          const press = () => handle.dispatchEvent(new KeyboardEvent('keydown', how))
          const timer = setInterval(press, every)
          setTimeout(() => { clearInterval(timer); done() }, lasts)
        })""",
        [HELD, REPEAT],
    )
    seen = _seen(tab)
    lasted = (seen["keys"][-1] - seen["keys"][0]) / 1e3
    told = [
        f"{answer} {sum(at < seen['keys'][-1] for at in seen[name]) / lasted:.0f}"
        for answer, name in ANSWERS.items()
    ]
    moves = len(seen["keys"]) / lasted
    print(f"a key held down, {moves:.0f} moves a second; painted anew a second:", ", ".join(told))


def _right(judge: Judge, tab: Tab, path: Path) -> None:
    """Judge that what is shown at the end is what the API says of the value the slider has then."""
    handle = tab.page.get_by_role("slider", name=SLIDER, exact=True)
    setting = {SLIDER: str(handle.get_attribute("aria-valuetext")).replace("·", "*")}
    found = apc.region(path, set=setting)
    share = found.stable_area / float(found.rectangle.width.prod())
    text = tab.page.evaluate(f"{MODEL}('region-words').text")
    print(f"the region at {setting[SLIDER]}:", judge.right("the region", f"{100 * share:.3g} %" in text))


if __name__ == "__main__":
    main()
