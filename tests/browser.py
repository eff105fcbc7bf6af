"""Debian's Chromium without a window, for tests of pages; a test that cannot have it says so."""

import shutil
from contextlib import contextmanager

import pytest
from selenium import webdriver

BINARIES = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1100,760")


@contextmanager
def browser_or_why():
    """Give a browser; leave the test out, saying why, where none is installed."""
    program = next(filter(None, map(shutil.which, BINARIES)), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("no browser: as root on Debian ./run test installs chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    options.set_capability("goog:loggingPrefs", {"browser": "SEVERE"})
    for option in OPTIONS:
        options.add_argument(option)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        yield browser
    finally:
        browser.quit()
