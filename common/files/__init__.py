"""Files that survive a crash: atomic replacement, epochs, bookmarks."""
