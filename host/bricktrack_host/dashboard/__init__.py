"""The control page: all units in a browser, watched and commanded from one place."""
