"""A picture of the page of results with one shape open: python docs/page_picture.py build/demo/report.html NAME OUT.png

It needs Chromium (Debian: apt-get install chromium), playwright, and pillow.
"""

from __future__ import annotations

import io
import os
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

page_path = Path(sys.argv[1])
name = sys.argv[2]
out = Path(sys.argv[3])
flags = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    *(["--no-sandbox"] if os.geteuid() == 0 else []),
]
with sync_playwright() as driver:
    browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
    page = browser.new_page(viewport={"width": 1180, "height": 860}, color_scheme="light")
    page.goto(page_path.resolve().as_uri())
    page.locator(f"#shapes .shape[title='{name}']").click()
    cards = page.locator("#ranking-list canvas")
    while page.locator("#ranking-list canvas.drawn").count() < min(20, cards.count()):
        page.wait_for_timeout(100)
    page.locator("#shape").evaluate(
        "dialog => { dialog.style.border = 'none'; dialog.style.borderRadius = '0'; }"
    )
    shot = page.locator("#shape").screenshot()
    browser.close()
picture = Image.open(io.BytesIO(shot)).convert("RGB")
picture.quantize(128, dither=Image.Dither.NONE).save(out, optimize=True)
print(f"{out}: {out.stat().st_size // 1000} kB")
