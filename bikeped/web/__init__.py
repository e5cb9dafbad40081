"""The web pages: live view and alignment; plain HTML, CSS and JavaScript modules, no build step.

Each page is a module with one function that adds it to an application (`add_live`, `add_align`,
`add_testbench` in the lab): it calls `server.add_page(app, Page("/align", "Align", ...))`, which
serves `templates/<name>.html` inside `templates/frame.html` with its entry in the navigation, and
adds its own routes below the page's path. Every request goes through `security`. Files of `static/`
are served as `/static/<name>`; scripts are modules that import `/static/ui.js`.

The content security policy allows nothing inline: no `style="..."`, no `onclick`, no `innerHTML`
with text (use `el` of ui.js). Handlers raise BikepedError for bad input: the caller gets status 400
and `{"error": "..."}`. Slow computations go to `asyncio.to_thread`. No page changes a threshold of
the running service; the test bench needs the simulation and runs on its own.
"""
