// The form returns to the page that was requested. With a session it opens at once: the browser
// withholds the cookie from a link on another site, not from this page.
const next = location.pathname === "/login" ? "/" : location.pathname;
document.getElementById("next").value = next;
document.getElementById("token").focus();
const answer = await fetch("/session").catch(() => null);
if (answer?.ok && (await answer.json()).let_in) location.replace(next);
