// Keeps the plan's tiles up to date, moves between them by keys, and says so when the server is not heard.
window.bricktrack = {
  SILENT_MS: 5000,
  tile(name) { return document.querySelector(`.unit[data-unit="${CSS.escape(name)}"]`); },
  adoptPlan() {
    const plan = document.getElementById("plan");
    document.getElementById("plan-slot").append(plan);
    document.getElementById("early").remove();
    plan.addEventListener("keydown", (e) => this.go(e));
    plan.addEventListener("focusin", (e) => this.keepTab(e.target.closest(".unit")));
    this.heard();
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
    for (const tile of document.querySelectorAll(".unit")) {
      tile.classList.toggle("chosen", chosen.has(tile.dataset.unit));
      tile.setAttribute("aria-pressed", chosen.has(tile.dataset.unit));
    }
  },
  // One stop of the tab key for the whole plan: the tile that was gone to last.
  keepTab(tile) {
    if (!tile) return;
    document.querySelector('.unit[tabindex="0"]')?.setAttribute("tabindex", "-1");
    tile.setAttribute("tabindex", "0");
  },
  // To the nearest tile that way; sideways counts twice, so that rows and columns are kept.
  go(event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const from = event.target.closest(".unit");
    if (!way || !from) return;
    event.preventDefault();
    const middle = (tile) => {
      const box = tile.getBoundingClientRect();
      return [box.x + box.width / 2, box.y + box.height / 2];
    };
    const [x, y] = middle(from);
    let best = null;
    let least = Infinity;
    for (const tile of document.querySelectorAll(".unit")) {
      const [dx, dy] = [middle(tile)[0] - x, middle(tile)[1] - y];
      const ahead = dx * way[0] + dy * way[1];
      const aside = Math.abs(dx * way[1]) + Math.abs(dy * way[0]);
      if (ahead > 1 && ahead >= aside && ahead + 2 * aside < least) [best, least] = [tile, ahead + 2 * aside];
    }
    best?.focus();
  },
  heard() { this.heardAt = Date.now(); this.listen(); },
  // Without the server the states are old, and what is clicked would be sent when it is back: nothing can be.
  listen() {
    const isLost = Date.now() - this.heardAt > this.SILENT_MS;
    const banner = document.getElementById("lost");
    if (isLost !== banner?.hidden) return;
    banner.hidden = !isLost;
    for (const part of document.body.children) part.inert = isLost && part !== banner;
    if (isLost) window.socket.sendBuffer.length = 0;
    const since = new Date(this.heardAt).toLocaleTimeString();
    banner.querySelector("span").textContent = isLost
      ? `No word from the page's server since ${since}. What is shown is of then; no order can be given. It is tried again by itself.`
      : "";
  },
};
// From the first moment: a server may fall silent before the plan is there.
window.bricktrack.heardAt = Date.now();
setInterval(() => window.bricktrack.listen(), 500);
