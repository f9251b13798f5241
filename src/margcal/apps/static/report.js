// Copy buttons, and the start of the 3-D view. Without scripts the page shows still pictures instead.
(function () {
  "use strict";

  function say(button, word) {
    const before = button.textContent;
    button.textContent = word;
    setTimeout(function () { button.textContent = before; }, 1600);
  }

  function copyBySelection(text) {
    const area = document.createElement("textarea");
    area.value = text;
    area.className = "offscreen";
    document.body.appendChild(area);
    area.select();
    let done = false;
    try { done = document.execCommand("copy"); } catch (error) { done = false; }
    area.remove();
    return done;
  }

  for (const button of document.querySelectorAll("button.copy")) {
    button.hidden = false;
    button.addEventListener("click", function () {
      const text = document.getElementById(button.dataset.copy).textContent;
      const fallback = function () { say(button, copyBySelection(text) ? "Copied" : "Select it by hand"); };
      if (navigator.clipboard && navigator.clipboard.writeText) {
        navigator.clipboard.writeText(text).then(function () { say(button, "Copied"); }, fallback);
      } else {
        fallback();
      }
    });
  }

  const data = document.getElementById("sphere-data");
  const place = document.getElementById("viewer");
  if (data && place) margcalViewer(place, JSON.parse(data.textContent));
})();
