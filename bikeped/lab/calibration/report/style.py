"""How the calibration report looks: one style sheet, no script, light and print alike."""

STYLE = """
:root { color-scheme: light; --ink: #1a1a1a; --soft: #5a5a5a; --line: #dddddd; --blue: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0; background: #f4f4f2; color: var(--ink);
  font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 24px 20px 40px; }
h1 { font-size: 26px; margin: 0 0 14px; }
h2 { font-size: 18px; margin: 0 0 12px; }
h3 { font-size: 15px; margin: 14px 0 4px; }
section { background: #ffffff; border: 1px solid var(--line); border-radius: 8px;
  padding: 18px 20px; margin: 18px 0; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(165px, 1fr)); gap: 10px; }
.tile { background: #ffffff; border: 1px solid var(--line); border-radius: 8px;
  padding: 10px 14px; }
.tile b { display: block; font-size: 18px; color: var(--blue); white-space: nowrap; }
.tile span { font-size: 13px; color: var(--soft); }
.caution { background: #fff4df; border: 1px solid #e0b050; border-radius: 8px;
  padding: 2px 18px 6px; margin-top: 14px; }
ul { margin: 6px 0 10px; padding-left: 20px; }
.figure { display: block; max-width: 100%; width: 800px; margin: 10px 0; }
.pair { display: grid; grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); gap: 20px; }
.pair .figure { width: 620px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 4px 14px 4px 0; border-bottom: 1px solid var(--line);
  white-space: nowrap; }
th { color: var(--soft); font-weight: 600; }
tr.chosen td { font-weight: 700; background: #eaf3f9; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(330px, 1fr)); gap: 14px; }
.card { margin: 0; border: 1px solid var(--line); border-radius: 6px; overflow: hidden; }
.card svg { display: block; width: 100%; height: auto; background: #222222; }
.card figcaption { font-size: 12.5px; padding: 6px 10px; color: var(--soft); }
.card figcaption b { color: var(--ink); }
footer { color: var(--soft); font-size: 12.5px; }
@media (max-width: 760px) { .pair { grid-template-columns: minmax(0, 1fr); } }
@media print { body { background: #ffffff; } section { break-inside: avoid; } }
"""
