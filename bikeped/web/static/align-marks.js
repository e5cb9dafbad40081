// The list of marks and of distances between them; a row's inputs stay while its texts change.

import { $, el, setText } from "/static/ui.js";

// A field for a length in metres; `change` gets the number, or null where there is none.
function lengthInput(attributes, value, change) {
  const input = el("input", { type: "number", step: "any", max: 1000, ...attributes });
  if (value !== null && value !== undefined) input.value = value;
  input.addEventListener("input", () => change(input.validity.valid && input.value.trim() !== "" ? Number(input.value) : null));
  return input;
}

export class MarkList {
  // `on`: changed(), chosen(mark), removed(mark), betweenChanged()
  constructor(on) {
    this.on = on;
    this.list = $("#mark-list");
    this.betweenList = $("#between-list");
    this.rows = new Map();
  }

  show(marks) {
    for (const [id, row] of this.rows) {
      if (!marks.some((mark) => mark.id === id)) {
        row.node.remove();
        this.rows.delete(id);
      }
    }
    for (const mark of marks) {
      if (!this.rows.has(mark.id)) this.rows.set(mark.id, this.row(mark));
      const row = this.rows.get(mark.id);
      row.no.setAttribute("aria-pressed", String(Boolean(mark.chosen)));
      setText(row.says, mark.says ?? "");
      row.says.classList.toggle("off", Boolean(mark.off));
    }
    $("#no-marks").hidden = marks.length > 0;
    setText($("#marks-count"), marks.length ? `${marks.length}` : "");
    $("#export").disabled = $("#clear").disabled = marks.length === 0;
    $("#add-between").disabled = marks.length < 2;
  }

  row(mark) {
    const input = (name, label, value, least) => {
      const id = `${name}-${mark.id}`;
      const field = lengthInput({ id, min: least, inputmode: least === null ? null : "decimal", autocomplete: "off" }, value, (metres) => {
        mark[name] = metres;
        this.on.changed();
      });
      field.addEventListener("focus", () => this.on.chosen(mark));
      return [el("div", {}, el("label", { for: id }, label), field), field];
    };
    const [distance, distanceField] = input("distance_m", "Distance, m", mark.distance_m, 0.01);
    const [right] = input("right_m", "To the right, m", mark.right_m, null);
    const no = el("button", { type: "button", class: "no", "aria-label": `Mark ${mark.name}, show it`, onclick: () => this.on.chosen(mark, true) }, mark.name);
    const remove = el("button", { type: "button", "aria-label": `Delete mark ${mark.name}`, onclick: () => this.on.removed(mark) }, el("span", { "aria-hidden": "true" }, "✕"));
    const says = el("span", { class: "says" });
    const node = el("li", {}, no, distance, right, remove, says);
    this.list.append(node);
    return { node, no, says, distanceField };
  }

  focus(mark) {
    this.rows.get(mark.id)?.distanceField.focus();
  }

  // Rows of measured distances between two marks; `between` is changed in place.
  showBetween(between, marks) {
    const rows = between.map((pair, index) => {
      const choice = (key, label) => {
        const select = el("select", { "aria-label": label },
          marks.map((mark) => el("option", { value: mark.id, selected: mark.id === pair[key] }, mark.name)));
        select.addEventListener("change", () => {
          pair[key] = Number(select.value);
          this.on.betweenChanged();
        });
        return select;
      };
      const field = lengthInput({ min: 0.01, inputmode: "decimal", "aria-label": "Distance between them, m" }, pair.distance_m, (metres) => {
        pair.distance_m = metres;
        this.on.betweenChanged();
      });
      const remove = el("button", { type: "button", "aria-label": "Delete this distance", onclick: () => {
        between.splice(index, 1);
        this.showBetween(between, marks);
        this.on.betweenChanged();
      } }, el("span", { "aria-hidden": "true" }, "✕"));
      return el("li", {}, choice("first", "From mark"), choice("second", "To mark"), field, remove);
    });
    this.betweenList.replaceChildren(...rows);
  }
}
