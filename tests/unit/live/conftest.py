"""What the tests of the live view share."""

from browser import browser as browser
