"""The animation of the README from the page of a real run: ``experiments/demo/animate.py out/demo/report.html``.

Needs Chromium with its driver and selenium. Steps through the drive and photographs map and moment.
"""

from __future__ import annotations

import io
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from PIL import Image
from selenium import webdriver

OUT = Path(__file__).resolve().parents[2] / "docs" / "assets" / "demo.webp"
WIDTH, MOST = 860, 1_500_000
"""Pixels, and bytes that a README may ask its reader to load."""


def main() -> None:
    """Command line."""
    frames = photographs(Path(sys.argv[1]).resolve())
    for quality in (70, 55, 40, 25):
        content = io.BytesIO()
        frames[0].save(content, "WEBP", save_all=True, append_images=frames[1:], duration=220, loop=0, quality=quality)
        if content.tell() < MOST:
            break
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_bytes(content.getvalue())
    print(f"{OUT}: {len(frames)} frames, {content.tell() / 1e6:.2f} MB")


def photographs(page: Path) -> list[Image.Image]:
    """One picture of the stage for every update."""
    options = webdriver.ChromeOptions()
    words = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars",
             "--window-size=1280,1400")  # fmt: skip
    for word in words:
        options.add_argument(word)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        driver.get(page.as_uri())
        stage, slider = driver.find_element("id", "player"), driver.find_element("id", "slider")
        updates = int(slider.get_attribute("max") or 0) + 1
        driver.execute_script("document.querySelector('.bar').scrollIntoView()")
        return [photograph(driver, stage, t) for t in range(updates)]
    finally:
        driver.quit()


def photograph(driver: webdriver.Chrome, stage: Any, t: int) -> Image.Image:
    """The stage at update ``t``."""
    driver.execute_script("location.hash = arguments[0]", f"t={t}")
    time.sleep(0.15)
    picture = Image.open(io.BytesIO(stage.screenshot_as_png)).convert("RGB")
    return picture.resize((WIDTH, round(picture.height * WIDTH / picture.width)), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main()
