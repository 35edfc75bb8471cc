"""Where recordings lie, relative to the checkout: for those, too, who load nothing heavy."""

FOLDERS = ("data/recordings", "first_path", ".geodesics/bench/recordings")
