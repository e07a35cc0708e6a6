// Keeps the plan's tiles up to date and tells the page when one is chosen.
window.bricktrack = {
  tile(name) { return document.querySelector(`.unit[data-unit="${CSS.escape(name)}"]`); },
  adoptPlan() {
    document.getElementById("plan-slot").append(document.getElementById("plan"));
    document.getElementById("early").remove();
  },
  setStates(changes) {
    for (const [name, state, letter] of changes) {
      const tile = this.tile(name);
      if (!tile) continue;
      tile.dataset.state = state;
      tile.querySelector(".letter").textContent = letter;
      tile.querySelector("title").textContent = `${name}: ${state}`;
      tile.setAttribute("aria-label", `${name}: ${state}`);
    }
  },
  setChosen(names) {
    const chosen = new Set(names);
    for (const tile of document.querySelectorAll(".unit"))
      tile.classList.toggle("chosen", chosen.has(tile.dataset.unit));
  },
};
