"""What a page asks of a reader: bytes beside its library, sheets on paper, width on a telephone, words.

    calib run -o demo && python tests/bench/page.py demo/report.html

Exits 1 where the page is larger than 2 MB beside the library, prints on more than 12 sheets, is wider than a
window of 390 px, reports an error, or holds a figure without words for a screen reader.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

import _here  # noqa: F401
from chromium import browser_or_skip

from calib.show.charts import library

MOST_BYTES, MOST_SHEETS, NARROW_PX = 2_000_000, 12, 390


def main(page: Path) -> int:
    """Measure one page and print a line for each figure."""
    own = len(page.read_bytes()) - len(library().encode())
    with tempfile.TemporaryDirectory() as place:
        browser = browser_or_skip(Path(place))
        try:
            browser.open(page, NARROW_PX)
            wide = int(browser.run("document.documentElement.scrollWidth"))
            mute = int(
                browser.run("[...document.querySelectorAll('figure')].filter((c) => !c.ariaLabel).length")
            )
            sheets = len(re.findall(rb"/Type\s*/Page\b(?!s)", browser.pdf()))
            errors = list(browser.errors)
        finally:
            browser.close()
    print(f"beside the library   {own / 1e6:.3f} MB, at most {MOST_BYTES / 1e6:.0f}")
    print(f"printed              {sheets} sheets, at most {MOST_SHEETS}")
    print(f"at {NARROW_PX} px            {wide} px wide, {mute} figures without words, {len(errors)} errors")
    good = own <= MOST_BYTES and 0 < sheets <= MOST_SHEETS and wide <= NARROW_PX and not mute and not errors
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve()))
