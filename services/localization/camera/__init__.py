"""Camera-only localization: render-and-compare tracking against the tracker's own Gaussian map."""
