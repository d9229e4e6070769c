// Which lights the tiles have, and what the server learnt of them: a table that a key opens and closes.
const hour = (h) => `${String(Math.floor(h)).padStart(2, "0")}:${String(Math.floor(60 * (h % 1))).padStart(2, "0")} UTC`;
const named = ({ light, time_of_day_h }) =>
  (light || "own") + (time_of_day_h === null ? "" : `, ${hour(time_of_day_h)}`);

function saved({ saved_ratio, withdrawn }) {
  if (withdrawn) return "withdrawn";
  return saved_ratio === null ? "" : `${Math.round(100 * saved_ratio)} %`;
}

function cells(row) {
  const learnt = row.learnt_ms === null ? "" : new Date(row.learnt_ms).toLocaleString();
  return [row.tile, named(row), row.version, row.passes || "", learnt, saved(row)];
}

export function showTiles(details, rows) {
  details.hidden = !rows.length;
  details.querySelector("tbody").replaceChildren(...rows.map((row) => {
    const line = document.createElement("tr");
    line.append(...cells(row).map((text) => {
      const cell = document.createElement("td");
      cell.textContent = text;
      return cell;
    }));
    return line;
  }));
}
