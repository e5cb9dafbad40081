const show = (id, text) => { document.getElementById(id).textContent = text; };

async function update() {
  try {
    const status = await (await fetch("calibrate/status")).json();
    show("says", status.says);
    show("next", `Next: ${status.next}`);
    document.getElementById("bar").value = status.coverage;
    show("count", `${status.kept} boards kept, ${Math.round(100 * status.coverage)} % covered`);
  } catch {
    show("says", "the capture has ended");
  }
  setTimeout(update, 400);
}

update();
