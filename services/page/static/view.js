"use strict";
// The page of `beamsplat view`: the 3D viewer in the whole window.
const place = document.getElementById("view");
import("./viewer/viewer.js")
  .catch(() => { throw new Error("it was not built: run make web, then start beamsplat view again"); })
  .then(({ openViewer }) => openViewer(place, { base: "", saved: document.body.dataset.saved === "true", embedded: null }))
  .catch((error) => {
    const text = document.createElement("p");
    text.setAttribute("role", "alert");
    text.textContent = `The 3D view cannot be shown: ${error.message}.`;
    place.replaceChildren(text);
  });
