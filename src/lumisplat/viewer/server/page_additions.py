"""What the viewer adds to viser's page: its title, how controls look, lists that can be clicked, room for the panel.

Pages get it with the one HTML file that they load; it names elements as Mantine does, whose components these are.
"""

from __future__ import annotations

import gzip
from functools import lru_cache

TITLE = "Lumisplat"

_STYLE = """
/* Labels and numbers in full: viser squeezes letters, and leaves numbers less room than their arrows. */
label, .mantine-Text-root, .mantine-Input-input { letter-spacing: normal !important; }
label { font-size: 0.8125rem; }
.mantine-NumberInput-controls { display: none !important; }
.mantine-NumberInput-input { padding: 0 0.35em !important; font-size: 0.75rem !important; }
.mantine-Input-input:disabled, .mantine-Input-input[data-disabled] { opacity: 0.4 !important; }
.mantine-Slider-root + .mantine-NumberInput-root { width: 4.25rem !important; }
/* No hint over a list that is open. */
body:has(.mantine-Select-dropdown:not([style*="display: none"])) .mantine-Tooltip-tooltip { display: none !important; }
.lumi-command { box-sizing: border-box; width: calc(100% - 1.25rem); margin: 0 0.625rem 0.5em; font: 0.8rem monospace; }
/* The channel of lists: what is clicked in them is typed there. */
div:has(> .mantine-Flex-root label:empty):has(.mantine-TextInput-input) { display: none !important; }
.lumi-list { padding: 0 0.5em 0.3em; font-size: 0.875em; overflow-wrap: anywhere; }
.lumi-row { display: flex; align-items: center; gap: 0.5em; padding: 0.15em 0.4em; border-radius: 4px; }
.lumi-row[data-say], .lumi-row [data-say] { cursor: pointer; }
.lumi-row[data-say]:hover, .lumi-row [data-say]:hover { background: rgba(128, 128, 128, 0.2); }
.lumi-row.selected { background: rgba(255, 176, 32, 0.22); font-weight: 600; }
.lumi-row.hidden > .lumi-name { opacity: 0.45; text-decoration: line-through; }
.lumi-name { flex-grow: 1; }
.lumi-key .lumi-name { white-space: nowrap; }
.lumi-row svg { width: 1.15em; height: 1.15em; flex-shrink: 0; display: block; }
.lumi-row span[data-say]:not(.lumi-name) { padding: 0.2em; border-radius: 4px; opacity: 0.4; }
.lumi-row span[data-say].on, .lumi-row span[data-say]:hover { opacity: 1 !important; }
.lumi-detail { opacity: 0.6; font-size: 0.85em; padding: 0 0.4em 0 2.1em; }
.lumi-problem { color: #e5534b; padding: 0.2em 0.4em; }
.lumi-keys { display: flex; flex-wrap: wrap; gap: 0.4em; padding: 0 0.5em 0.4em; font-size: 0.8em; }
.lumi-key { width: 7.2em; border-radius: 4px; overflow: hidden; background: rgba(128, 128, 128, 0.15); }
.lumi-key img { display: block; width: 100%; cursor: pointer; }
.lumi-key img:hover { opacity: 0.85; }
.lumi-key .lumi-row { padding: 0 0.2em; gap: 0; }
/* Over the picture, while there is none yet. */
.lumi-wait { position: fixed; z-index: 5; left: calc(0.5 * (100vw - var(--lumi-panel, 0px)));
  top: calc(0.5 * (100vh - var(--lumi-drawer, 0px))); transform: translate(-50%, -50%);
  width: min(22rem, 70vw); padding: 0.9em 1.2em; border-radius: 8px; color: #eee;
  background: rgba(20, 20, 20, 0.82); pointer-events: none; text-align: center; overflow-wrap: anywhere; }
.lumi-wait i { display: block; height: 4px; margin-top: 0.7em; border-radius: 2px; background: #555; }
.lumi-wait b { display: block; height: 4px; border-radius: 2px; background: #4dabf7; transition: width 0.2s; }
/* Phones: the panel is a drawer of the whole width, and the picture has what it leaves free. */
@media (max-width: 36em) {
  .mantine-Paper-root[style*="bottom: 0"] { width: 100% !important; max-height: 50% !important; }
  .mantine-Paper-root[style*="bottom: 0"] [style*="width: 20em"] { width: 100% !important; }
  div[data-lumi-canvas] { height: calc(100% - var(--lumi-drawer, 0px)) !important; }
}
"""

_SCRIPT = """
const setValue = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
let said = 0;
// An element with data-say was clicked: its words are typed into the text control that data-to names.
function say(element) {
  const to = element.closest('[data-to]');
  const label = to && document.querySelector(`label[for="${to.dataset.to}"]`);
  const input = label && label.closest('.mantine-Flex-root').querySelector('input');
  if (!input) return;
  setValue.call(input, `${element.dataset.say} ${++said}`);
  input.dispatchEvent(new Event('input', {bubbles: true}));
}
document.addEventListener('click', (event) => {
  const element = event.target.closest && event.target.closest('[data-say]');
  if (element) say(element);
});
document.addEventListener('keydown', (event) => {
  if (event.key === 'Enter' && event.target.dataset && event.target.dataset.say) say(event.target);
});
// What CSS alone cannot select, or measure.
function arrange() {
  for (const note of document.querySelectorAll('.mantine-Notification-root')) {
    // The pictures are made by the server: only handles are drawn by the browser.
    if (note.textContent.startsWith('Software WebGL')) note.querySelector('button')?.click();
  }
  const drawer = document.querySelector('.mantine-Paper-root[style*="position: fixed"][style*="bottom: 0"]');
  const canvas = document.querySelector('canvas');
  const box = canvas && canvas.closest('[style*="flex-grow: 1"][style*="height: 100%"]');
  if (box && !box.dataset.lumiCanvas) box.dataset.lumiCanvas = 'yes';
  measure('--lumi-drawer', drawer ? drawer.offsetHeight : 0);
  measure('--lumi-panel', canvas ? innerWidth - canvas.getBoundingClientRect().width : 0);
}
function measure(name, pixels) {
  const style = document.documentElement.style;
  if (style.getPropertyValue(name) !== `${pixels}px`) style.setProperty(name, `${pixels}px`);
}
let waits = false;
new MutationObserver(() => {
  if (waits) return;
  waits = true;
  setTimeout(() => { waits = false; arrange(); }, 60);
}).observe(document, {subtree: true, childList: true, attributes: true, attributeFilter: ['style', 'class']});
addEventListener('resize', arrange);
"""


@lru_cache(maxsize=2)
def with_additions(body: bytes, *, is_packed: bool) -> bytes:
    """Returns viser's page with what the viewer adds to it.

    Args:
        body: The HTML.
        is_packed: Whether it is compressed by gzip, and is to be.
    """
    page = gzip.decompress(body) if is_packed else body
    head = f"<title>{TITLE}</title><style>{_STYLE}</style><script>{_SCRIPT}</script>"
    page = page.replace(b"<title>Viser</title>", head.encode(), 1)
    return gzip.compress(page) if is_packed else page
